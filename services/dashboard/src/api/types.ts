// The generated types as the service answers them: keys with defaults are always there.
import type * as Generated from "./schema";

export type {
  Animation,
  AssetAnswer,
  CameraState,
  EnvironmentLights,
  FisheyeLights,
  LiveCamera,
  LiveHeader,
  Material,
  Output,
  PictureState,
  Pose,
  Problem,
  ProcessAnswer,
  RevisionEntry,
  RoomAnswer,
  RoomsAnswer,
  State,
  SceneSummary,
  Settings,
  Surface,
  TrackedLamp,
} from "./schema";

export type {
  FisheyeAnswer as Fisheye,
  Pick as PickAnswer,
  RecordingAnswer as Recording,
  ReplayAnswer as Replay,
  ReplayChange,
  ShelfAnswer as ShelfItem,
  SnapshotFacts as Snapshot,
  VideoAnswer as Video,
  TicketAnswer as Ticket,
} from "./schema";

export type SceneObject = Generated.SceneObject & { readonly pose: Generated.Pose };
export type Lights = Generated.Lights & {
  readonly environment: Generated.EnvironmentLights;
  readonly fisheye: Generated.FisheyeLights;
};
export type ManualLight = Lights["manual"][number];
export type LightType = ManualLight["type"];
export type Method = NonNullable<Generated.SceneDocument["method"]>;
export type MethodName = Method["name"];
/** What can be looked at: a view of the scene's document, or the camera's own picture. */
export type View = Generated.LiveHeader["view"];
export type RealScene = Generated.RealScene;

export type SceneDocument = Omit<Generated.SceneDocument, "objects" | "lights" | "method" | "output" | "real"> & {
  readonly objects: readonly SceneObject[];
  readonly lights: Lights;
  readonly method: Method;
  readonly output: Generated.Output;
  readonly real: RealScene;
};
export type SceneAnswer = Omit<Generated.SceneAnswer, "document"> & { readonly document: SceneDocument };

export type Vector = readonly [number, number, number];
export type Quaternion = readonly [number, number, number, number];

/** What one picture of a snapshot shows; `camera` is the camera's own picture. */
export interface WantedPicture {
  readonly name: string;
  readonly view: View;
  readonly method?: Method | { readonly name: MethodName };
}
