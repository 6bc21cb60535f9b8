import { change, objects } from "../../state/scene";
import { selectObject } from "../../state/selection";

/** The object's id, which names it for people and programs. */
export function NameField({ id, disabled }: { readonly id: string; readonly disabled: boolean }) {
  const rename = async (input: HTMLInputElement): Promise<void> => {
    const name = input.value.trim();
    if (name === id || name === "") {
      input.value = id;
      return;
    }
    const item = objects.value.find((each) => each.id === id);
    if (await change("PUT", `/objects/${encodeURIComponent(id)}`, { ...item, id: name }, { strict: true }))
      selectObject(name);
    else input.value = id;
  };
  return (
    <input
      class="input name-input"
      aria-label="Name"
      value={id}
      maxLength={200}
      disabled={disabled}
      onKeyDown={(event) => event.key === "Enter" && event.currentTarget.blur()}
      onBlur={(event) => void rename(event.currentTarget)}
    />
  );
}
