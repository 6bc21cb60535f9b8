import { API } from "../../api/http";
import type { AssetAnswer } from "../../api/types";
import { boundsOf, size } from "../../math/bounds";
import { bytes, sizesText } from "../../math/units";
import { addObject } from "../../state/actions";
import { assetName, removeAsset } from "../../state/assets";
import { ASSET_DRAG } from "../../state/drag";
import { edit } from "../../state/gesture";
import { inspectorTab } from "../../state/selection";
import { partTarget } from "../../state/targets";
import { download } from "../ui/download";
import { Icon } from "../ui/Icon";
import { Menu, type MenuEntry } from "../ui/Menu";
import { SecureImage } from "../ui/SecureImage";

interface AssetCardProps {
  readonly asset: AssetAnswer;
  readonly mayChange: boolean;
}

export function AssetCard({ asset, mayChange }: AssetCardProps) {
  const name = assetName(asset);
  const path = `${API}/assets/${asset.asset}`;
  const use = asset.kind === "mesh" ? () => addObject(asset) : () => lightWith(asset);
  const entries: MenuEntry[] = [
    {
      label: asset.kind === "mesh" ? "Add to the scene" : "Light the scene with it",
      icon: "add",
      disabled: !mayChange,
      onClick: use,
    },
    { label: "Download", icon: "download", onClick: () => download(`${path}/content`, name) },
    { label: "Delete", icon: "trash", disabled: !mayChange, onClick: () => removeAsset(asset) },
  ];
  return (
    <li
      class="asset"
      draggable={mayChange && asset.kind === "mesh"}
      onDragStart={(event) => event.dataTransfer?.setData(ASSET_DRAG, asset.asset)}
    >
      <button
        type="button"
        class="asset-use"
        disabled={!mayChange}
        aria-label={`${asset.kind === "mesh" ? "Add" : "Light the scene with"} ${name}`}
        title={factsText(asset)}
        onClick={use}
      >
        <SecureImage path={`${path}/thumbnail.png`} alt="" className="asset-picture" />
        <span class="cut">{name}</span>
      </button>
      <Menu label={`Actions for ${name}`} entries={entries} side="right" kind="icon-only plain">
        <Icon name="more" />
      </Menu>
    </li>
  );
}

async function lightWith(asset: AssetAnswer): Promise<void> {
  inspectorTab.value = "lights";
  await edit(partTarget("lights"), { mode: "environment", environment: { map: asset.asset } });
}

function factsText(asset: AssetAnswer): string {
  const bounds = boundsOf(asset, null);
  const { triangles, width, height } = asset.facts;
  const facts = [
    asset.format.toUpperCase(),
    bytes(asset.size_bytes),
    ...(typeof triangles === "number" ? [`${triangles.toLocaleString("en")} triangles`] : []),
    ...(bounds ? [sizesText(size(bounds))] : []),
    ...(typeof width === "number" && typeof height === "number" ? [`${width} × ${height}`] : []),
  ];
  return facts.join(", ");
}
