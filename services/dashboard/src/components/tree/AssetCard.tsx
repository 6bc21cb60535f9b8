import { API } from "../../api/http";
import type { AssetAnswer } from "../../api/types";
import { boundsOf, size } from "../../math/bounds";
import { bytes, counted, sizesText } from "../../math/units";
import { addObject } from "../../state/actions";
import { assetName, removeAsset } from "../../state/assets";
import { ASSET_DRAG } from "../../state/drag";
import { edit } from "../../state/gesture";
import { inspectorTab, selectedObjectId } from "../../state/selection";
import { objectTarget, partTarget } from "../../state/targets";
import { toast } from "../../state/toasts";
import { download } from "../ui/download";
import { Icon } from "../ui/Icon";
import { Menu, type MenuEntry } from "../ui/Menu";
import { SecureImage } from "../ui/SecureImage";

interface Use {
  readonly label: string;
  /** Said before the asset's name. */
  readonly verb: string;
  readonly run: (asset: AssetAnswer) => unknown;
}

const USES: Readonly<Record<AssetAnswer["kind"], Use>> = {
  mesh: { label: "Add to the scene", verb: "Add", run: (asset) => addObject(asset) },
  map: { label: "Use as environment light", verb: "Light the scene with", run: lightWith },
  material: { label: "Apply to the selected object", verb: "Apply to the selected object:", run: paintWith },
};

interface AssetCardProps {
  readonly asset: AssetAnswer;
  readonly mayChange: boolean;
}

export function AssetCard({ asset, mayChange }: AssetCardProps) {
  const name = assetName(asset);
  const path = `${API}/assets/${asset.asset}`;
  const { label, verb, run } = USES[asset.kind];
  const use = (): unknown => run(asset);
  const entries: MenuEntry[] = [
    { label, icon: "add", disabled: !mayChange, onClick: use },
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
        aria-label={`${verb} ${name}`}
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

async function paintWith(asset: AssetAnswer): Promise<void> {
  const id = selectedObjectId.value;
  if (id === null) {
    toast("First select the object that should get this material.");
    return;
  }
  await edit(objectTarget(id), { material: { precomputed: asset.asset } });
}

function factsText(asset: AssetAnswer): string {
  const bounds = boundsOf(asset, null);
  const { triangles, width, height } = asset.facts;
  const facts = [
    asset.format.toUpperCase(),
    bytes(asset.size_bytes),
    ...(typeof triangles === "number" ? [counted(triangles, "triangle")] : []),
    ...(bounds ? [sizesText(size(bounds))] : []),
    ...(typeof width === "number" && typeof height === "number" ? [`${width} × ${height}`] : []),
  ];
  return facts.join(", ");
}
