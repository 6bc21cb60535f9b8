import { announcement, dismiss, hold, release, toasts } from "../../state/toasts";
import { Icon } from "./Icon";
import { IconButton } from "./IconButton";
import { Sentence } from "./Sentence";

/** Sentences over the page, and the line that only screen readers get. */
export function Toasts() {
  return (
    <>
      <div class="toasts" role="region" aria-label="Messages">
        {toasts.value.map((each) => (
          <div
            key={each.id}
            class={`toast ${each.kind}`}
            role={each.kind === "error" ? "alert" : "status"}
            onPointerEnter={() => hold(each)}
            onPointerLeave={() => release(each)}
            onFocusIn={() => hold(each)}
            onFocusOut={() => release(each)}
          >
            <Icon name={each.kind === "error" ? "alert" : "info"} />
            <p>
              <Sentence text={each.text} />
            </p>
            <IconButton icon="close" label="Dismiss" onClick={() => dismiss(each.id)} />
          </div>
        ))}
      </div>
      <div class="visually-hidden" aria-live="polite">
        {announcement.value}
      </div>
    </>
  );
}
