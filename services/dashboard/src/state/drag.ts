// Assets that are dragged from their list onto the picture.
import type { AssetAnswer } from "../api/types";
import { assets } from "./assets";

export const ASSET_DRAG = "application/x-deltalight-asset";

export function droppedAsset(name: string | undefined): AssetAnswer | null {
  return assets.value.find((each) => each.asset === name && each.kind === "mesh") ?? null;
}
