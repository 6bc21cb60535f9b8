import type uPlot from "uplot";
import { delay, DELAY_TIP, delayText, shown } from "../../live/delay";
import { bitrate, frame, rate } from "../../live/picture";
import { noVideo } from "../../live/video";
import { leadingPasses, OTHERS, samples, stacked, timeOf, type Sample } from "../../live/telemetry";
import { bitrateText, milliseconds, rateText } from "../../math/units";
import { Empty } from "../ui/Empty";
import { Plot, type Series } from "./Plot";

// Hues at even steps and of one lightness, so that none looks more important; warm first, as the sign's.
const COLORS = ["#f0a03c", "#5b9df0", "#67b86a", "#d673c4", "#e0705c", "#46b8b0", "#a78bf0", "#8d9096"];
const MOST_PASSES = COLORS.length - 1;

/** Times of the passes, delay and rate of the last minute. */
export function PerformancePanel() {
  const all = samples.value;
  const last = all.at(-1);
  if (!last) {
    return (
      <Empty icon="chart" title="No frames yet">
        <p>Plots of the last minute appear with the live picture.</p>
      </Empty>
    );
  }
  const names = leadingPasses(all, MOST_PASSES);
  const times = all.map((sample) => sample.at - last.at);
  return (
    <div class="performance">
      <figure class="plot-box wide">
        <figcaption>Renderer passes, ms</figcaption>
        <Plot
          label="Time of each pass, stacked, in milliseconds"
          series={areas(names)}
          data={stackData(times, all, names)}
        />
      </figure>
      <PassLegend sample={last} names={names} />
      <figure class="plot-box">
        <figcaption title={DELAY_TIP}>
          Delay <b>{delayText(delay.value)}</b>
        </figcaption>
        <Plot label="Delay in milliseconds" series={line("delay", "#f0a03c")} data={delayData(last.at)} />
      </figure>
      <figure class="plot-box">
        <figcaption>
          Rate <b>{rateText(rate.value)}</b> <span title={codecTip()}>{codecText()}</span>
        </figcaption>
        <Plot label="Frames per second" series={line("rate", "#5b9df0")} data={[times, all.map((each) => each.rate)]} />
      </figure>
    </div>
  );
}

/** What the pictures are coded as, and what they take on the network: "H.264, 412 kbit/s". */
function codecText(): string {
  const name = frame.value?.codec.startsWith("avc1") ? "H.264" : "JPEG";
  return `${name}, ${bitrateText(bitrate.value)}`;
}

function codecTip(): string {
  return noVideo.value === null ? `Encoded as ${frame.value?.codec ?? "–"}` : `JPEG: ${noVideo.value}`;
}

/** Times before `now`, and the delay of what was shown then. */
function delayData(now: number): uPlot.AlignedData {
  return [shown.value.map((each) => each.at - now), shown.value.map((each) => each.delay)];
}

/** The highest area is drawn first, so that the lower ones lie over it. */
function stackData(times: number[], all: readonly Sample[], names: readonly string[]): uPlot.AlignedData {
  return [times, ...stacked(all, names).reverse()];
}

function areas(names: readonly string[]): Series[] {
  return names
    .map((label, index) => ({ label, color: COLORS[index] ?? COLORS[MOST_PASSES]!, isFilled: true }))
    .reverse();
}

function line(label: string, color: string): Series[] {
  return [{ label, color, isFilled: false }];
}

function PassLegend({ sample, names }: { readonly sample: Sample; readonly names: readonly string[] }) {
  const total = Object.values(sample.passes).reduce((sum, time) => sum + time, 0);
  return (
    <table class="legend">
      <caption>
        {frame.value?.renderer} <b>{milliseconds(total)}</b>
      </caption>
      <tbody>
        {names.map((name, index) => (
          <tr key={name} class={sample.reused.has(name) ? "reused" : ""}>
            <th scope="row">
              <i style={{ background: COLORS[index] }} />
              <span class="cut">{name.replaceAll("_", " ")}</span>
            </th>
            <td>{passText(sample, name, names)}</td>
          </tr>
        ))}
      </tbody>
      {sample.reused.size > 0 && (
        <tfoot>
          <tr>
            <td colSpan={2}>Nothing is moving: pale passes are reused and show the time of their last run.</td>
          </tr>
        </tfoot>
      )}
    </table>
  );
}

function passText(sample: Sample, name: string, names: readonly string[]): string {
  return name === OTHERS || name in sample.passes ? timeOf(sample, name, names).toFixed(1) : "–";
}
