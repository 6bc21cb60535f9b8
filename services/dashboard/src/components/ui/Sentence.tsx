/** A sentence of the service; what stands between backticks is a command. */
export function Sentence({ text }: { readonly text: string }) {
  return <>{text.split("`").map((part, index) => (index % 2 === 1 ? <code key={index}>{part}</code> : part))}</>;
}
