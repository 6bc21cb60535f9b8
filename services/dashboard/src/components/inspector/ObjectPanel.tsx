import { role } from "../../api/session";
import type { SceneObject } from "../../api/types";
import { size } from "../../math/bounds";
import { sizesText } from "../../math/units";
import { duplicateObject, removeObject, setVisible } from "../../state/actions";
import { assetName, assets, boundsByObject } from "../../state/assets";
import { isSceneRead } from "../../state/scene";
import { selectedObject } from "../../state/selection";
import { tool } from "../../state/tools";
import { Button } from "../ui/Button";
import { Empty } from "../ui/Empty";
import { Skeleton } from "../ui/Skeleton";
import { IconButton } from "../ui/IconButton";
import { AnimationSection } from "./AnimationSection";
import { MaterialSection } from "./MaterialSection";
import { NameField } from "./NameField";
import { PoseSection } from "./PoseSection";
import { FrameSection } from "./FrameSection";

export function ObjectPanel() {
  const item = selectedObject.value;
  if (!isSceneRead.value) return <Skeleton lines={4} />;
  if (!item) {
    return (
      <Empty icon="cursor" title="No object selected">
        <p>Click an object in the picture or in the list. To add one, drop a .glb file onto the picture.</p>
      </Empty>
    );
  }
  const mayChange = role.value === "control";
  return (
    <>
      <ObjectHead item={item} mayChange={mayChange} />
      <PoseSection item={item} disabled={!mayChange} />
      <MaterialSection item={item} disabled={!mayChange} />
      <AnimationSection item={item} disabled={!mayChange} />
      <FrameSection item={item} disabled={!mayChange} />
    </>
  );
}

function ObjectHead({ item, mayChange }: { readonly item: SceneObject; readonly mayChange: boolean }) {
  const asset = assets.value.find((each) => each.asset === item.asset);
  const bounds = boundsByObject.value.get(item.id);
  const measures = bounds ? sizesText(size(bounds).map((edge) => edge * item.pose.scale)) : "";
  return (
    <section class="section head" aria-label="Object">
      <div class="row">
        <div class="grow">
          <NameField id={item.id} disabled={!mayChange} />
        </div>
        <IconButton
          icon={item.visible ? "eye" : "hidden"}
          label={item.visible ? "Hide" : "Show"}
          disabled={!mayChange}
          onClick={() => setVisible(item.id, !item.visible)}
        />
        <IconButton
          icon="copy"
          label="Duplicate"
          hint="Ctrl+D"
          disabled={!mayChange}
          onClick={() => duplicateObject(item.id)}
        />
        <IconButton
          icon="trash"
          label="Remove"
          hint="Del"
          disabled={!mayChange}
          onClick={() => removeObject(item.id)}
        />
      </div>
      <p class="quiet small">
        {asset ? assetName(asset) : "The file is missing"}
        {measures && `, ${measures}`}
      </p>
      <Button icon="place" disabled={!mayChange} onClick={() => (tool.value = "place")}>
        {tool.value === "place" ? "Click where it should stand" : "Place on a surface"}
      </Button>
    </section>
  );
}
