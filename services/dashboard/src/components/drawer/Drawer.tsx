import { drawerTab, isDrawerOpen, openDrawer, type DrawerTab } from "../../state/preferences";
import { Boundary } from "../ui/Boundary";
import { IconButton } from "../ui/IconButton";
import { Tabs, type Tab } from "../ui/Tabs";
import { ComparePanel } from "./ComparePanel";
import { HistoryPanel } from "./HistoryPanel";
import { NodesPanel } from "./NodesPanel";
import { PerformancePanel } from "./PerformancePanel";
import { RecordingsPanel } from "./RecordingsPanel";
import { ReplayBar } from "./ReplayBar";
import { SnapshotsPanel } from "./SnapshotsPanel";

const TABS: readonly Tab<DrawerTab>[] = [
  { value: "performance", label: "Performance", icon: "chart" },
  { value: "nodes", label: "Nodes", icon: "node" },
  { value: "recordings", label: "Recordings", icon: "film" },
  { value: "snapshots", label: "Snapshots", icon: "camera" },
  { value: "compare", label: "Compare", icon: "compare" },
  { value: "history", label: "History", icon: "history" },
];
const PANEL_ID = "drawer";

/** What is looked at now and then: opened by its tabs, closed by the arrow or the open tab. */
export function Drawer() {
  const isOpen = isDrawerOpen.value;
  const tab = drawerTab.value;
  const choose = (next: DrawerTab): void => {
    if (isOpen && next === tab) isDrawerOpen.value = false;
    else openDrawer(next);
  };
  return (
    <section class="drawer" aria-label="Performance, nodes and recordings">
      <ReplayBar />
      <div class="drawer-bar">
        <Tabs label="Drawer" tabs={TABS} value={isOpen ? tab : null} onChange={choose} panelId={PANEL_ID} />
        <IconButton
          icon={isOpen ? "down" : "up"}
          label={isOpen ? "Close the drawer" : "Open the drawer"}
          onClick={() => (isDrawerOpen.value = !isOpen)}
        />
      </div>
      {isOpen && (
        <div class="drawer-body" role="tabpanel" tabIndex={0} id={PANEL_ID} aria-labelledby={`${PANEL_ID}-${tab}`}>
          <Boundary key={tab} name="This panel">
            <Panel tab={tab} />
          </Boundary>
        </div>
      )}
    </section>
  );
}

function Panel({ tab }: { readonly tab: DrawerTab }) {
  switch (tab) {
    case "performance":
      return <PerformancePanel />;
    case "nodes":
      return <NodesPanel />;
    case "recordings":
      return <RecordingsPanel />;
    case "snapshots":
      return <SnapshotsPanel />;
    case "compare":
      return <ComparePanel />;
    case "history":
      return <HistoryPanel />;
  }
}
