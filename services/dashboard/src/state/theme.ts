// Dark or light: as the system prefers, until somebody chooses.
import { effect, signal } from "@preact/signals";

const KEY = "deltalight.theme";
const prefersLight = matchMedia("(prefers-color-scheme: light)");

export type Theme = "dark" | "light";

const chosen = signal<Theme | null>(readChoice());
const preferred = signal<Theme>(prefersLight.matches ? "light" : "dark");

export function theme(): Theme {
  return chosen.value ?? preferred.value;
}

export function toggleTheme(): void {
  const next = theme() === "dark" ? "light" : "dark";
  chosen.value = next;
  localStorage.setItem(KEY, next);
}

export function applyTheme(): void {
  prefersLight.addEventListener("change", () => (preferred.value = prefersLight.matches ? "light" : "dark"));
  effect(() => {
    document.documentElement.dataset.theme = theme();
  });
}

function readChoice(): Theme | null {
  const kept = localStorage.getItem(KEY);
  return kept === "dark" || kept === "light" ? kept : null;
}
