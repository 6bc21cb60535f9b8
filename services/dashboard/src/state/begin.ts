// Beginning and end of a session with the service.
import { effect, signal } from "@preact/signals";
import { API, ProblemError, request } from "../api/http";
import { keepToken, phase, signInProblem, token } from "../api/session";
import type { Settings } from "../api/types";
import { chooseCodec, startPicture, stopPicture } from "../live/picture";
import { startEvents, stopEvents } from "./events";
import { readSchemas } from "../forms/schemas";

const RETRY_MS = 3000;

export const needsToken = signal(false);
export const uploadLimitBytes = signal(Infinity);
/** Whether a still stands for the live picture until it comes. */
export const hasPoster = signal(false);
/** Whether the camera's picture of that frame is there too. */
export const hasPosterBefore = signal(false);

/** Ask the service what it needs; the sign-in page comes up where that is a token. */
export async function begin(): Promise<void> {
  try {
    const settings = await request<Settings>("GET", `${API}/settings`);
    needsToken.value = settings.needs_token;
    uploadLimitBytes.value = settings.upload_limit_bytes;
    hasPoster.value = settings.has_poster;
    hasPosterBefore.value = settings.has_poster_before;
    await readSchemas();
    phase.value = "ready";
    await chooseCodec(settings.no_h264);
    startEvents();
    startPicture();
  } catch (fault) {
    if (fault instanceof ProblemError && fault.status === 401) return;
    phase.value = "unreachable";
    setTimeout(() => void begin(), RETRY_MS);
  }
}

export async function signIn(given: string): Promise<void> {
  signInProblem.value = "";
  keepToken(given.trim());
  await begin();
}

/** Without a token nothing is asked for, until somebody signs in. */
export function followSession(): void {
  effect(() => {
    if (phase.value !== "sign-in") return;
    stopEvents();
    stopPicture();
  });
}

export function signOut(): void {
  keepToken(null);
  signInProblem.value = "";
  phase.value = "sign-in";
}

export const isSignedIn = (): boolean => token.value !== null;
