import { lights, objects } from "../../state/scene";
import { selectedLight, selectedObjectId, selectLight, selectObject } from "../../state/selection";

/** Tab walks through objects and lamps while something is selected; past the last it leaves the picture. */
export function stepSelection(event: KeyboardEvent): boolean {
  if (event.key !== "Tab" || (selectedObjectId.value === null && selectedLight.value === null)) return false;
  const lampCount = lights.value?.mode === "manual" ? lights.value.manual.length : 0;
  const steps: (() => void)[] = [
    ...objects.value.map((item) => () => selectObject(item.id)),
    ...Array.from({ length: lampCount }, (_, index) => () => selectLight(index)),
  ];
  const current =
    selectedLight.value === null
      ? objects.value.findIndex((item) => item.id === selectedObjectId.value)
      : objects.value.length + selectedLight.value;
  const next = steps[current + (event.shiftKey ? -1 : 1)];
  next?.();
  return next !== undefined;
}
