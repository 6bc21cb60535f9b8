import { role } from "../../api/session";
import type { Lights } from "../../api/types";
import { edit } from "../../state/gesture";
import { lights } from "../../state/scene";
import { partTarget } from "../../state/targets";
import { toast } from "../../state/toasts";
import { assets } from "../../state/assets";
import { hasFisheye } from "../../state/processes";
import { Segments, type Segment } from "../ui/Segments";
import { useStateWatch } from "../ui/useStateWatch";
import { EnvironmentSection } from "./EnvironmentSection";
import { FisheyeSection } from "./FisheyeSection";
import { LightSection } from "./LightSection";
import { ManualList } from "./ManualList";
import { RegistrationSection } from "./RegistrationSection";
import { Section } from "./Section";
import { TrackedSection } from "./TrackedSection";

type Mode = Lights["mode"];

const MODES: readonly Segment<Mode>[] = [
  { value: "manual", label: "Manual" },
  { value: "fisheye", label: "Fish-eye" },
  { value: "tracked", label: "Tracked" },
  { value: "environment", label: "Map" },
];
const HELP: Readonly<Record<Mode, string>> = {
  manual: "Lights that you set by hand.",
  fisheye: "Live light, seen by a fish-eye camera beside the objects.",
  tracked: "Lamps that carry a marker, so that you can move them.",
  environment: "A panorama of the surroundings (HDR or EXR).",
};

const NO_FISHEYE = "Fish-eye light needs a fish-eye camera, and none is sending.";

export function LightsPanel() {
  const found = lights.value;
  useStateWatch();
  if (!found) return null;
  const disabled = role.value !== "control";
  return (
    <>
      <Section title="Light source">
        <Segments
          label="Light mode"
          segments={MODES.map((each) => ({ ...each, reason: reasonAgainst(each.value, found) }))}
          value={found.mode}
          onChange={(mode) => setMode(found, mode)}
          disabled={disabled}
        />
        <p class="quiet small">{HELP[found.mode]}</p>
        {hasFisheye.value === false && <p class="quiet small">{NO_FISHEYE}</p>}
      </Section>
      {found.mode === "manual" && <ManualList lights={found} disabled={disabled} />}
      {found.mode === "manual" && <LightSection lights={found} disabled={disabled} />}
      {found.mode === "tracked" && <TrackedSection lights={found} disabled={disabled} />}
      {found.mode === "environment" && <EnvironmentSection lights={found} disabled={disabled} />}
      {(found.mode === "fisheye" || found.mode === "environment") && (
        <FisheyeSection lights={found} disabled={disabled} />
      )}
      <RegistrationSection lights={found} disabled={disabled} />
    </>
  );
}

/** Why a mode cannot be chosen. */
function reasonAgainst(mode: Mode, current: Lights): string | undefined {
  return mode === "fisheye" && current.mode !== mode && hasFisheye.value === false ? NO_FISHEYE : undefined;
}

/** Some modes need something to begin with. */
async function setMode(current: Lights, mode: Mode): Promise<void> {
  const target = partTarget("lights");
  if (mode === "environment" && current.environment.map == null) {
    const map = assets.value.find((each) => each.kind === "map");
    if (!map) {
      toast("Upload an environment map first: drop an .hdr or .exr file onto Assets.");
      return;
    }
    await edit(target, { mode, environment: { map: map.asset } });
  } else if (mode === "tracked" && current.tracked.length === 0) {
    await edit(target, { mode, tracked: [{ marker: 0 }] });
  } else {
    await edit(target, { mode });
  }
}
