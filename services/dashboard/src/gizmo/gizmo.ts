// The gizmo: three's TransformControls, drawn over the picture with that frame's own camera.
import { Group, PerspectiveCamera, Quaternion, Scene, Vector3, WebGLRenderer } from "three";
import { TransformControls } from "three/examples/jsm/controls/TransformControls.js";
import type { Pose } from "../api/types";
import { eyeOf, project, projectPinhole, projectionMatrix, type Pixel, type View } from "../math/camera";
import { SNAP_DEG, SNAP_M, SNAP_SCALE } from "../math/snap";
import { length, subtract } from "../math/vector";

export type GizmoMode = "translate" | "rotate" | "scale";
/** What a handle does: `free` moves over the picture or the ground, `bound` along an axis, or it turns or scales. */
export type Grip = "free" | "bound";

interface GizmoEvents {
  readonly onStart: () => void;
  readonly onMove: (pose: Pose) => void;
  readonly onEnd: () => void;
}

const SIZE = 1.35;
const FREE_HANDLES = ["XYZ", "XY"];
const NEAR_M = 0.01;
// OpenCV's camera looks along +z with y down, three's along -z with y up.
const FLIP = [1, -1, -1] as const;

export class Gizmo {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera();
  private readonly held = new Group();
  private readonly controls: TransformControls;
  private readonly start = { position: new Vector3(), quaternion: new Quaternion(), scale: 1 };
  private view: View | null = null;
  private isQueued = false;
  private isShown = false;

  /** `surface` gets the pointer's events and has the picture's outline. Throws where there is no WebGL. */
  constructor(
    canvas: HTMLCanvasElement,
    private readonly surface: HTMLElement,
    private readonly events: GizmoEvents,
  ) {
    this.renderer = new WebGLRenderer({ canvas, alpha: true, antialias: true });
    this.renderer.setPixelRatio(devicePixelRatio);
    this.camera.matrixAutoUpdate = false;
    this.controls = new TransformControls(this.camera, surface);
    this.controls.setSize(SIZE);
    this.controls.setColors(0xf2655e, 0x6cc04a, 0x4f9df7, 0xffc470);
    this.scene.add(this.held, this.controls.getHelper());
    this.controls.addEventListener("mouseDown", () => this.begin());
    this.controls.addEventListener("objectChange", () => this.report());
    this.controls.addEventListener("mouseUp", () => this.events.onEnd());
    this.controls.addEventListener("change", () => this.queue());
  }

  get isDragging(): boolean {
    return this.controls.dragging;
  }

  /** Whether the pointer is on one of the handles. */
  get isTouched(): boolean {
    return this.isShown && this.controls.axis !== null;
  }

  /** The handle at a pointer; a finger hovers nowhere before it is there, so it is looked for anew. */
  gripAt(event: PointerEvent): Grip | null {
    if (!this.isShown) return null;
    const { left, top, width, height } = this.surface.getBoundingClientRect();
    const x = ((event.clientX - left) / width) * 2 - 1;
    const y = 1 - ((event.clientY - top) / height) * 2;
    this.controls.pointerHover({ x, y, button: event.button } as unknown as PointerEvent);
    if (this.controls.axis === null) return null;
    return this.controls.mode === "translate" && FREE_HANDLES.includes(this.controls.axis) ? "free" : "bound";
  }

  /** Leave the pointer to others; the handle that it is on stays lit. */
  pause(isPaused: boolean): void {
    this.controls.enabled = !isPaused;
  }

  dispose(): void {
    this.controls.dispose();
    this.renderer.dispose();
  }

  setSnapping(isOn: boolean): void {
    this.controls.setTranslationSnap(isOn ? SNAP_M : null);
    this.controls.setRotationSnap(isOn ? (SNAP_DEG * Math.PI) / 180 : null);
    this.controls.setScaleSnap(isOn ? SNAP_SCALE : null);
  }

  setSize(width: number, height: number): void {
    this.renderer.setSize(width, height, false);
    this.queue();
  }

  /** Hold a pose, or nothing; what is being dragged stays where the pointer has it. */
  hold(pose: Pose | null, mode: GizmoMode): void {
    this.isShown = pose !== null;
    if (!pose) {
      this.controls.detach();
    } else if (!this.isDragging) {
      this.place(pose);
      this.controls.setMode(mode);
      this.controls.attach(this.held);
    }
    this.aim();
  }

  setView(view: View | null): void {
    this.view = view;
    this.aim();
  }

  /** Put what is dragged back to where it was. */
  cancel(): boolean {
    if (!this.isDragging) return false;
    this.controls.reset();
    this.report();
    this.controls.dragging = false;
    this.controls.axis = null;
    this.events.onEnd();
    return true;
  }

  private place(pose: Pose): void {
    const [w, x, y, z] = pose.rotation_wxyz;
    this.held.position.set(...pose.translation_m);
    this.held.quaternion.set(x, y, z, w);
    this.held.scale.setScalar(pose.scale);
  }

  private begin(): void {
    this.start.scale = this.held.scale.x;
    this.events.onStart();
  }

  private report(): void {
    const { position, quaternion, scale } = this.held;
    if (this.controls.mode === "scale") this.scaleEvenly(scale);
    this.events.onMove({
      translation_m: [position.x, position.y, position.z],
      rotation_wxyz: [quaternion.w, quaternion.x, quaternion.y, quaternion.z],
      scale: scale.x,
    });
  }

  /** Any of the three handles scales all: objects have one factor. */
  private scaleEvenly(scale: Vector3): void {
    const changed = scale
      .toArray()
      .reduce((far, each) => (Math.abs(each - this.start.scale) > Math.abs(far - this.start.scale) ? each : far));
    scale.setScalar(Math.max(1e-4, Math.abs(changed)));
  }

  private aim(): void {
    if (this.view) {
      const { lens, worldFromCamera } = this.view;
      const rows = worldFromCamera.flatMap((row) => row.map((each, at) => each * (FLIP[at] ?? 1)));
      this.camera.matrix.fromArray(rows).transpose();
      this.camera.matrixWorldNeedsUpdate = true;
      const origin = this.held.position;
      const distance = length(subtract([origin.x, origin.y, origin.z], eyeOf(this.view)));
      const matrix = projectionMatrix(lens, NEAR_M, 100 + 10 * distance, this.lensShift(this.view));
      this.camera.projectionMatrix.fromArray(matrix);
      this.camera.projectionMatrixInverse.copy(this.camera.projectionMatrix).invert();
      this.camera.fov = (2 * Math.atan(lens.height / 2 / lens.fy) * 180) / Math.PI; // the handles' size follows it
      this.camera.updateMatrixWorld(true);
    }
    this.queue();
  }

  /** How far the lens shows the gizmo's origin from where a pinhole would: the drawing is exact there. */
  private lensShift(view: View): Pixel {
    const { x, y, z } = this.held.position;
    const shown = project(view, [x, y, z]);
    const straight = projectPinhole(view, [x, y, z]);
    return shown && straight ? [shown[0] - straight[0], shown[1] - straight[1]] : [0, 0];
  }

  private queue(): void {
    if (this.isQueued) return;
    this.isQueued = true;
    requestAnimationFrame(() => {
      this.isQueued = false;
      this.controls.getHelper().visible = this.isShown && this.view !== null;
      this.renderer.render(this.scene, this.camera);
    });
  }
}
