// The room in 3-D: what the render server has of it, the scene's objects, lamps and the camera, seen from anywhere.
import {
  AmbientLight,
  Box3,
  Box3Helper,
  Color,
  Group,
  Mesh,
  MeshStandardMaterial,
  PerspectiveCamera,
  Scene,
  Spherical,
  Vector3,
  WebGLRenderer,
  type Object3D,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import type { Lights, Material, SceneObject } from "../api/types";
import type { Bounds } from "../math/bounds";
import type { View } from "../math/camera";
import { cameraMark, lampMark, lightOf } from "./marks";

/** The bytes of an asset's GLB file; null where it is of another kind. */
export type ReadAsset = (asset: string) => Promise<ArrayBuffer | null>;

const TURN_RAD = Math.PI / 24; // of an arrow key
const ZOOM = 1.15; // of a key
const STEEPEST_RAD = 0.05;
// Where it is first seen from: beside and above the camera, so that the room's depth shows.
const FIRST_TURN_RAD = 0.5;
const FIRST_RISE_RAD = 0.25;
const FIRST_DISTANCE = 1.9;
const USUAL_FOV_DEG = 50;
const Y_TO_Z_RAD = Math.PI / 2;

export class Room {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera(USUAL_FOV_DEG, 1, 0.01, 200);
  private readonly controls: OrbitControls;
  private readonly loader = new GLTFLoader();
  private readonly surfaces = new Group();
  private readonly objects = new Group();
  private readonly marks = new Group();
  private readonly models = new Map<string, Promise<Object3D | null>>();
  private readonly middle = new Vector3();
  private isQueued = false;
  private shownObjects = 0;

  /** Throws where there is no WebGL. */
  constructor(
    canvas: HTMLCanvasElement,
    private readonly readAsset: ReadAsset,
  ) {
    this.renderer = new WebGLRenderer({ canvas, alpha: true, antialias: true });
    this.renderer.setPixelRatio(devicePixelRatio);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.queue());
    this.surfaces.rotation.x = Y_TO_Z_RAD;
    this.scene.add(this.surfaces, this.objects, this.marks);
  }

  dispose(): void {
    this.controls.dispose();
    for (const part of [this.surfaces, this.objects, this.marks]) clear(part);
    this.renderer.dispose();
  }

  setSize(width: number, height: number): void {
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.queue();
  }

  /** Take the real scene, a GLB file. */
  async setSurfaces(file: ArrayBuffer): Promise<void> {
    const { scene } = await this.loader.parseAsync(file, "");
    clear(this.surfaces);
    this.surfaces.add(scene);
    this.surfaces.updateMatrixWorld(true);
    new Box3().setFromObject(this.surfaces).getCenter(this.middle);
    this.queue();
  }

  /** Take the scene's objects; those that are not GLB files are boxes. */
  async setObjects(items: readonly SceneObject[], boxes: ReadonlyMap<string, Bounds>): Promise<void> {
    const turn = ++this.shownObjects;
    const shown = items.filter((item) => item.visible && item.frame === "world");
    const made = await Promise.all(shown.map((item) => this.objectOf(item, boxes.get(item.id) ?? null)));
    if (turn !== this.shownObjects) return; // a newer scene has come meanwhile
    this.objects.clear();
    for (const each of made) this.objects.add(each);
    this.queue();
  }

  /** Take the lamps and the newest frame's camera. */
  setMarks(lights: Lights | null, view: View | null): void {
    clear(this.marks);
    const lamps = lights?.mode === "manual" ? lights.manual : [];
    for (const lamp of lamps) this.marks.add(...lightOf(lamp), ...lampMark(lamp));
    if (lamps.length === 0) this.marks.add(new AmbientLight("white", Math.PI / 2));
    if (view) this.marks.add(cameraMark(view));
    this.queue();
  }

  /** Look from beside the camera. */
  lookFrom({ worldFromCamera: m }: View): void {
    const eye = new Vector3(m[0]![3], m[1]![3], m[2]![3]);
    const ahead = new Vector3(m[0]![2], m[1]![2], m[2]![2]);
    const distance = Math.max(0.2, ahead.dot(this.middle.clone().sub(eye)));
    this.controls.target.copy(eye).addScaledVector(ahead, distance);
    this.camera.position.copy(eye);
    this.turn(FIRST_TURN_RAD, FIRST_RISE_RAD, FIRST_DISTANCE);
  }

  /** Act on a key; false where it means nothing. */
  press(key: string): boolean {
    const turns: Readonly<Record<string, readonly [number, number, number]>> = {
      ArrowLeft: [-TURN_RAD, 0, 1],
      ArrowRight: [TURN_RAD, 0, 1],
      ArrowUp: [0, TURN_RAD, 1],
      ArrowDown: [0, -TURN_RAD, 1],
      "+": [0, 0, 1 / ZOOM],
      "=": [0, 0, 1 / ZOOM],
      "-": [0, 0, ZOOM],
    };
    const turn = turns[key];
    if (turn) this.turn(...turn);
    return turn !== undefined;
  }

  /** Turn about the target to the right and up, radians, at a multiple of the distance. */
  private turn(right: number, up: number, distance: number): void {
    const { target } = this.controls;
    const [x, y, z] = this.camera.position.clone().sub(target).toArray();
    const around = new Spherical().setFromCartesianCoords(x, z, -y); // three's are about y
    around.theta += right;
    around.phi = Math.max(STEEPEST_RAD, Math.min(Math.PI - STEEPEST_RAD, around.phi - up));
    around.radius *= distance;
    const turned = new Vector3().setFromSpherical(around);
    this.camera.position.set(turned.x, -turned.z, turned.y).add(target);
    this.controls.update();
    this.queue();
  }

  private async objectOf(item: SceneObject, bounds: Bounds | null): Promise<Object3D> {
    const model = await this.modelOf(item.asset);
    const placed = new Group();
    const [w, x, y, z] = item.pose.rotation_wxyz;
    placed.position.set(...item.pose.translation_m);
    placed.quaternion.set(x, y, z, w);
    placed.scale.setScalar(item.pose.scale);
    if (model) placed.add(dressed(model, item));
    else if (bounds) placed.add(outline(bounds));
    return placed;
  }

  private modelOf(asset: string): Promise<Object3D | null> {
    const known = this.models.get(asset) ?? this.readModel(asset);
    this.models.set(asset, known);
    return known;
  }

  private async readModel(asset: string): Promise<Object3D | null> {
    try {
      const file = await this.readAsset(asset);
      return file && (await this.loader.parseAsync(file, "")).scene;
    } catch {
      return null; // its box stands for what this page cannot read
    }
  }

  private queue(): void {
    if (this.isQueued) return;
    this.isQueued = true;
    requestAnimationFrame(() => {
      this.isQueued = false;
      this.renderer.render(this.scene, this.camera);
    });
  }
}

/** A copy of a model (y up, unless the object says otherwise), in the object's own material where it has one. */
function dressed(model: Object3D, { material, up_axis }: SceneObject): Object3D {
  const copy = model.clone();
  if (up_axis !== "z") copy.rotation.x = Y_TO_Z_RAD;
  if (!material || !("base_color" in material)) return copy;
  const own = ownMaterial(material);
  copy.traverse((part) => {
    if (isMesh(part)) part.material = own;
  });
  return copy;
}

function ownMaterial({ base_color, metallic, roughness, emission }: Material): MeshStandardMaterial {
  return new MeshStandardMaterial({
    color: new Color().fromArray([...base_color]),
    metalness: metallic,
    roughness,
    emissive: new Color().fromArray([...emission]),
  });
}

function outline({ minimum, maximum }: Bounds): Object3D {
  return new Box3Helper(new Box3(new Vector3(...minimum), new Vector3(...maximum)), 0xffffff);
}

/** Empty a group and free what it held on the graphics card. */
function clear(group: Group): void {
  group.traverse((part) => {
    if (isMesh(part)) {
      part.geometry.dispose();
      for (const material of [part.material].flat()) material.dispose();
    }
  });
  group.clear();
}

function isMesh(part: Object3D): part is Mesh {
  return part instanceof Mesh;
}
