import { signal } from "@preact/signals";
import { version } from "../../api/session";
import { isGuideDismissed } from "../../state/preferences";
import { Button } from "../ui/Button";
import { Dialog } from "../ui/Dialog";

export const areKeysShown = signal(false);

const GROUPS: readonly { readonly title: string; readonly keys: readonly (readonly [string, string])[] }[] = [
  {
    title: "Tools",
    keys: [
      ["Q", "select"],
      ["G or W", "move"],
      ["R or E", "rotate"],
      ["S", "scale"],
      ["P", "place on a surface: click the spot"],
      ["F", "stand on surfaces while dragging, or keep the height"],
      ["Shift", "snap to 1 cm, 15°, 0.1 while dragging"],
      ["Esc", "cancel the drag, or clear the selection"],
    ],
  },
  {
    title: "With the picture focused",
    keys: [
      ["Arrows", "move the selection by 1 cm"],
      ["Page Up / Down", "move it up, down"],
      ["Shift / Alt", "with arrows: 10 cm, 1 mm"],
      ["[ and ]", "rotate by 15°"],
      ["Tab", "next object or light"],
    ],
  },
  {
    title: "Scene",
    keys: [
      ["Ctrl Z", "undo"],
      ["Ctrl Shift Z", "redo"],
      ["Ctrl D", "duplicate the object"],
      ["Del", "remove the selection"],
      ["H", "hide or show outlines"],
    ],
  },
  {
    title: "Views",
    keys: [
      ["1", "picture"],
      ["2 … 8", "effects, change of light, its error, volume, light's view, lights, camera"],
      ["O", "room in 3-D; arrow keys orbit, + and − zoom"],
      ["?", "show this list"],
    ],
  },
];

export function KeysDialog() {
  if (!areKeysShown.value) return null;
  const showGuide = (): void => {
    isGuideDismissed.value = false;
    areKeysShown.value = false;
  };
  return (
    <Dialog title="Keyboard shortcuts" onClose={() => (areKeysShown.value = false)}>
      <div class="keys">
        {GROUPS.map((group) => (
          <section key={group.title}>
            <h3>{group.title}</h3>
            <dl>
              {group.keys.map(([key, text]) => (
                <>
                  <dt>
                    <kbd>{key}</kbd>
                  </dt>
                  <dd>{text}</dd>
                </>
              ))}
            </dl>
          </section>
        ))}
      </div>
      <div class="spread dialog-end">
        <Button onClick={showGuide}>Show “Try this” again</Button>
        <span class="quiet small">Deltalight {version.value}</span>
      </div>
    </Dialog>
  );
}
