import { rate } from "../../live/picture";
import { rateText, trimmed } from "../../math/units";
import { isSilent, renderServerName, type Seen } from "../../state/processes";
import { Sentence } from "../ui/Sentence";

const RATE_NAMES: Readonly<Record<string, string>> = { fps: "frames", without_board: "frames without the board" };

export function ProcessCard({ seen }: { readonly seen: Seen }) {
  const { report } = seen;
  // The page's own rate of pictures stands for the renderer's, so that there is one number.
  const rates = Object.entries(report.rates).filter(([name]) => name !== "frames_per_s");
  const drops = Object.entries(report.drops).filter(([, count]) => count > 0);
  return (
    <article class="card process" aria-label={report.name} tabIndex={0}>
      <header class="spread">
        <h3>{report.name}</h3>
        <span class={`badge ${isSilent(seen) ? "bad" : report.state}`}>{isSilent(seen) ? "silent" : report.state}</span>
      </header>
      {report.detail && (
        <p class="quiet small">
          <Sentence text={report.detail} />
        </p>
      )}
      <dl>
        {report.name === renderServerName.value && <Row name="frames" value={rateText(rate.value)} />}
        {rates.map(([name, each]) => (
          <Row
            key={name}
            name={RATE_NAMES[name] ?? name}
            value={name in RATE_NAMES ? rateText(each) : `${trimmed(each, 1)}/s`}
          />
        ))}
        {drops.map(([name, count]) => (
          <Row key={name} name={`dropped: ${name}`} value={String(count)} />
        ))}
        <Row
          name="clock error"
          value={report.clock_bound_ms == null ? "unknown" : `within ${trimmed(report.clock_bound_ms, 2)} ms`}
        />
      </dl>
    </article>
  );
}

function Row({ name, value }: { readonly name: string; readonly value: string }) {
  return (
    <div class="spread">
      <dt class="cut">{name.replaceAll("_", " ")}</dt>
      <dd>{value}</dd>
    </div>
  );
}
