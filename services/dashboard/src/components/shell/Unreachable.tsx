import { Mark } from "../ui/Mark";

/** Shown until the service answers for the first time; the page tries again by itself. */
export function Unreachable() {
  return (
    <main class="sign-in">
      <form>
        <Mark />
        <div role="status">
          <h1>The service does not answer</h1>
          <p class="quiet">
            See whether <code>deltalight up</code> or <code>deltalight api</code> still runs. This page tries again
            every three seconds.
          </p>
        </div>
      </form>
    </main>
  );
}
