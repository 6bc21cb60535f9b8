// What this browser keeps of how the page is set up.
import { effect, signal, type Signal } from "@preact/signals";

export type DrawerTab = "performance" | "nodes" | "recordings" | "snapshots" | "compare" | "history";

function kept<T>(name: string, initial: T): Signal<T> {
  const key = `deltalight.${name}`;
  let value = initial;
  try {
    const text = localStorage.getItem(key);
    if (text !== null) value = JSON.parse(text) as T;
  } catch {
    // what an older page kept in another form is left behind
  }
  const result = signal(value);
  effect(() => localStorage.setItem(key, JSON.stringify(result.value)));
  return result;
}

// On a tablet the picture needs the room that the list of the scene would take.
const isWide = matchMedia("(min-width: 1100px)").matches;

export const isTreeOpen = kept("tree", isWide);
export const isInspectorOpen = kept("inspector", true);
export const isDrawerOpen = kept("drawer", false);
export const drawerTab = kept<DrawerTab>("drawer-tab", "performance");
export const isGuideDismissed = kept("guide-dismissed", false);

export type GuideStep = "drag" | "drop" | "light" | "camera" | "compare";
/** What of the guide was tried. */
export const tried = kept<readonly GuideStep[]>("guide-tried", []);

export function noteTried(step: GuideStep): void {
  if (!tried.value.includes(step)) tried.value = [...tried.value, step];
}

/** An object that is dragged stands on what the camera sees under it; without, it keeps its height. */
export const standsOnSurfaces = kept("stands-on-surfaces", true);
/** It leans with a slope that it is dragged onto; without, it stays turned as it is. */
export const leansWithSurfaces = kept("leans-with-surfaces", false);

/** Recordings keep the relit pictures too. */
export const recordsRelit = kept("records-relit", false);

export function openDrawer(tab: DrawerTab): void {
  drawerTab.value = tab;
  isDrawerOpen.value = true;
}
