import { role } from "../../api/session";
import type { ComponentChildren } from "preact";
import { isGuideDismissed, openDrawer, tried, type GuideStep } from "../../state/preferences";
import { objects } from "../../state/scene";
import { inspectorTab, selectedObjectId, selectObject } from "../../state/selection";
import { isMovable } from "../../state/takes";
import { IconButton } from "../ui/IconButton";

interface StepProps {
  readonly of: GuideStep;
  readonly children: ComponentChildren;
}

/** One thing to try, with a tick once it was. */
function Step({ of, children }: StepProps) {
  const isDone = tried.value.includes(of);
  return (
    <li class={isDone ? "done" : ""}>
      {children}
      {isDone && <span class="visually-hidden">Done.</span>}
    </li>
  );
}

/** What to try first, ticked off as it is tried; goes for good when it is closed. */
export function Guide() {
  if (isGuideDismissed.value || role.value !== "control") return null;
  const first = objects.value[0];
  const isShort = inspectorTab.value !== "object" || selectedObjectId.value !== null;
  return (
    <section class={`guide ${isShort ? "short" : ""}`} aria-label="Try this">
      <header class="spread">
        <h2>Try this</h2>
        <IconButton icon="close" label="Close Try this" onClick={() => (isGuideDismissed.value = true)} />
      </header>
      <ol>
        <Step of="drag">
          <button type="button" disabled={!first} onClick={() => first && selectObject(first.id)}>
            Drag the object
          </button>
          <span>Click it, then drag it or its arrows. Its shadow and reflected colour follow.</span>
        </Step>
        <Step of="drop">
          <b>Drop a .glb onto the picture</b>
          <span>It stands where you let go.</span>
        </Step>
        <Step of="light">
          <button type="button" onClick={() => (inspectorTab.value = "lights")}>
            Change the light
          </button>
          <span>Set the colour, strength and position of each light. Or drag a shadow, and its light follows.</span>
        </Step>
        {isMovable.value && (
          <Step of="camera">
            <b>Move the camera</b>
            <span>Drag the slider below the picture, or press Play.</span>
          </Step>
        )}
        <Step of="compare">
          <button type="button" onClick={() => openDrawer("compare")}>
            Compare methods
          </button>
          <span>See one frame rendered by two methods, with a split to drag.</span>
        </Step>
      </ol>
    </section>
  );
}
