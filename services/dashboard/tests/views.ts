// A camera for tests.
import { lensOf, type View } from "../src/math/camera";

// 1 m above the board's origin, looking straight down: optical x = world x, optical y = world -y.
export const ABOVE: View = {
  lens: lensOf({
    width: 640,
    height: 480,
    matrix: [600, 0, 319.5, 0, 600, 239.5, 0, 0, 1],
    distortion_model: "plumb_bob",
    distortion: [],
  }),
  worldFromCamera: [
    [1, 0, 0, 0],
    [0, -1, 0, 0],
    [0, 0, -1, 1],
    [0, 0, 0, 1],
  ],
};
