import { useState } from "preact/hooks";
import { change, objects } from "../../state/scene";
import { selectObject } from "../../state/selection";

/** The object's id, which names it for people and programs. */
export function NameField({ id, disabled }: { readonly id: string; readonly disabled: boolean }) {
  const [typed, setTyped] = useState<string | null>(null); // kept while the scene changes meanwhile
  const rename = async (): Promise<void> => {
    const name = (typed ?? "").trim();
    setTyped(null);
    if (name === id || name === "") return;
    const item = objects.value.find((each) => each.id === id);
    if (await change("PUT", `/objects/${encodeURIComponent(id)}`, { ...item, id: name }, { strict: true }))
      selectObject(name);
  };
  return (
    <input
      class="input name-input"
      aria-label="Name"
      value={typed ?? id}
      maxLength={200}
      disabled={disabled}
      onKeyDown={(event) => event.key === "Enter" && event.currentTarget.blur()}
      onInput={(event) => setTyped(event.currentTarget.value)}
      onBlur={() => void rename()}
    />
  );
}
