import { inspectorTab, selectedObjectId, type InspectorTab } from "../../state/selection";
import { Boundary } from "../ui/Boundary";
import { Tabs, type Tab } from "../ui/Tabs";
import { Guide } from "./Guide";
import { LightsPanel } from "./LightsPanel";
import { MethodPanel } from "./MethodPanel";
import { ObjectPanel } from "./ObjectPanel";
import { OutputPanel } from "./OutputPanel";
import { RealPanel } from "./RealPanel";

const TABS: readonly Tab<InspectorTab>[] = [
  { value: "object", label: "Object" },
  { value: "lights", label: "Lights" },
  { value: "real", label: "Real" },
  { value: "method", label: "Method" },
  { value: "output", label: "Output" },
];
const PANEL_ID = "inspector";

export function Inspector() {
  const tab = inspectorTab.value;
  return (
    <aside class="side right" aria-label="Inspector">
      <Tabs
        label="Inspector"
        tabs={TABS}
        value={tab}
        onChange={(next) => (inspectorTab.value = next)}
        panelId={PANEL_ID}
      />
      <div class="scroll" role="tabpanel" tabIndex={0} id={PANEL_ID} aria-labelledby={`${PANEL_ID}-${tab}`}>
        <Boundary key={`${tab} ${selectedObjectId.value ?? ""}`} name="The inspector">
          <Panel tab={tab} />
        </Boundary>
      </div>
      <Guide />
    </aside>
  );
}

function Panel({ tab }: { readonly tab: InspectorTab }) {
  switch (tab) {
    case "object":
      return <ObjectPanel />;
    case "lights":
      return <LightsPanel />;
    case "real":
      return <RealPanel />;
    case "method":
      return <MethodPanel />;
    case "output":
      return <OutputPanel />;
  }
}
