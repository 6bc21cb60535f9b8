// Uploads with progress, which fetch does not tell.
import { API, ProblemError, authorization, refusal } from "./http";
import type { AssetAnswer, Recording } from "./types";

const UPLOAD_TYPE = "application/octet-stream";

type Progress = (share: number) => void;

/** Send a file; `onProgress` gets 0..1, and stays at 1 while the service checks the file. */
export function uploadAsset(file: File, onProgress: Progress): Promise<AssetAnswer> {
  return send<AssetAnswer>("assets", file, onProgress);
}

/** The same for a recording, or a zipped dataset folder. */
export function uploadRecording(file: File, onProgress: Progress): Promise<Recording> {
  return send<Recording>("recordings/upload", file, onProgress);
}

function send<Answer>(path: string, file: File, onProgress: Progress): Promise<Answer> {
  return new Promise((resolve, reject) => {
    const sending = new XMLHttpRequest();
    sending.open("POST", `${API}/${path}?name=${encodeURIComponent(file.name)}`);
    authorization().forEach((value, name) => sending.setRequestHeader(name, value));
    sending.setRequestHeader("Content-Type", UPLOAD_TYPE);
    sending.upload.onprogress = (event) => {
      if (event.lengthComputable) onProgress(event.loaded / event.total);
    };
    sending.onerror = () =>
      reject(new ProblemError(0, "unreachable", `${file.name} could not be uploaded; try again.`));
    sending.onload = () => {
      if (sending.status < 300) resolve(JSON.parse(sending.responseText) as Answer);
      else reject(refusal(sending.status, sending.responseText));
    };
    sending.send(file);
  });
}
