// Which room this page shows: that of its address (`?room=NAME`), else the first.
const NAME = "room";

export const room: string | null = new URLSearchParams(location.search).get(NAME);

/** The address of the page of a room. */
export function pageOf(name: string): string {
  const address = new URL(location.href);
  address.searchParams.set(NAME, name);
  address.searchParams.delete("camera"); // it is another room's
  return address.href;
}
