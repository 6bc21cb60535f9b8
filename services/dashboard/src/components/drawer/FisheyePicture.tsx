import { API } from "../../api/http";
import { hexFromLinear } from "../../math/color";
import { fisheye } from "../../state/processes";
import { Icon } from "../ui/Icon";
import { SecureImage } from "../ui/SecureImage";

/** The fish-eye picture with the lights that were found in it. */
export function FisheyePicture() {
  const seen = fisheye.value;
  if (!seen) {
    return (
      <article class="card fisheye-none" aria-label="Fish-eye camera">
        <Icon name="eye" />
        <p class="quiet small">No fish-eye camera sends. With one, lights of the room are found by themselves.</p>
      </article>
    );
  }
  return (
    <article class="card fisheye" aria-label="Fish-eye camera">
      <div class="fisheye-picture" style={{ aspectRatio: `${seen.width} / ${seen.height}` }}>
        <SecureImage path={`${API}/fisheye.jpg?seen=${seen.seen_ns}`} alt="Fish-eye picture" />
        <svg viewBox={`0 0 ${seen.width} ${seen.height}`} role="img" aria-label={`${seen.lights.length} lights`}>
          {seen.lights.map((light, index) => (
            <g key={index}>
              <circle
                cx={light.x}
                cy={light.y}
                r={Math.max(light.radius_px, seen.width / 60)}
                stroke={hexFromLinear(light.color_linear)}
              />
              <text x={light.x + light.radius_px + seen.width / 50} y={light.y}>
                {index + 1}
              </text>
            </g>
          ))}
        </svg>
      </div>
      <p class="small">
        <b>Fish-eye camera</b>
        <br />
        <span class="quiet">{seen.lights.length === 1 ? "1 light found" : `${seen.lights.length} lights found`}</span>
      </p>
    </article>
  );
}
