import { Mark } from "../ui/Mark";

/** Shown until the service answers for the first time; the page tries again by itself. */
export function Unreachable() {
  return (
    <main class="sign-in">
      <form>
        <Mark />
        <div role="status">
          <h1>The server does not respond</h1>
          <p class="quiet">
            Check that <code>deltalight up</code> or <code>deltalight api</code> is still running. This page retries
            every three seconds.
          </p>
        </div>
      </form>
    </main>
  );
}
