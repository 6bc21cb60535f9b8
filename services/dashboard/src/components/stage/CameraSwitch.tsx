import { frame } from "../../live/picture";
import { cameras, chooseCamera, chosenCamera } from "../../state/cameras";
import { Select } from "../ui/Select";

/** Whose picture is shown; only where the room has several cameras. */
export function CameraSwitch() {
  if (cameras.value.length < 2) return null;
  const shown = chosenCamera.value ?? frame.value?.node ?? cameras.value[0]!.name;
  const choices = cameras.value.map(({ name, status }) => ({
    value: name,
    label: status === "live" ? name : `${name} (${status.replace("_", " ")})`,
  }));
  return <Select label="Camera" value={shown} choices={choices} onChange={chooseCamera} />;
}
