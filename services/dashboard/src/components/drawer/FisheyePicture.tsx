import { API } from "../../api/http";
import type { Fisheye } from "../../api/types";
import { hexFromLinear } from "../../math/color";
import { counted, trimmed } from "../../math/units";
import { fisheye } from "../../state/processes";
import { Icon } from "../ui/Icon";
import { SecureImage } from "../ui/SecureImage";

// Less of a picture that is too bright to be measured changes no light.
const SOME = 0.0005;

/** The fish-eye picture with the lights that were found in it. */
export function FisheyePicture() {
  const seen = fisheye.value;
  if (!seen) {
    return (
      <article class="card fisheye-none" aria-label="Fish-eye camera">
        <Icon name="eye" />
        <p class="quiet small">
          No fish-eye camera is sending. With one, Deltalight finds the lights of the room automatically.
        </p>
      </article>
    );
  }
  const found = counted(seen.lights.length, "light");
  return (
    <article class="card fisheye" aria-label="Fish-eye camera">
      <div class="fisheye-picture" style={{ aspectRatio: `${seen.width} / ${seen.height}` }}>
        <SecureImage path={`${API}/fisheye.jpg?seen=${seen.seen_ns}`} alt="Fish-eye picture" />
        <svg viewBox={`0 0 ${seen.width} ${seen.height}`} role="img" aria-label={found}>
          {seen.lights.map((light, index) => (
            <g key={index}>
              <circle
                cx={light.x}
                cy={light.y}
                r={ringOf(light, seen.width)}
                stroke={hexFromLinear(light.color_linear)}
              />
              <text font-size={seen.width / 10} x={light.x + ringOf(light, seen.width) + seen.width / 60} y={light.y}>
                {index + 1}
              </text>
            </g>
          ))}
        </svg>
      </div>
      <div class="small">
        <b>Fish-eye camera</b>
        <p class="quiet">{found} found</p>
        <ol title="Irradiance of each light on a surface facing it; the camera shows 1 as white">
          {seen.lights.map((light, index) => (
            <li key={index}>
              {index + 1}
              <i class="tree-color" style={{ background: hexFromLinear(light.color_linear) }} />
              {trimmed(Math.max(...light.irradiance), 2)}
            </li>
          ))}
        </ol>
        {seen.clipped_share > SOME && <p class="quiet">{trimmed(100 * seen.clipped_share, 1)} % is overexposed</p>}
      </div>
    </article>
  );
}

/** Around the light, so that it stays visible inside. */
function ringOf({ radius_px }: Fisheye["lights"][number], width: number): number {
  return Math.max(1.6 * radius_px, width / 30);
}
