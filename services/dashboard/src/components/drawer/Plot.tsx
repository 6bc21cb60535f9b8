import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import { theme } from "../../state/theme";

export interface Series {
  readonly label: string;
  readonly color: string;
  readonly isFilled: boolean;
}

interface PlotProps {
  readonly label: string;
  readonly series: readonly Series[];
  /** Times, then one list for each series. */
  readonly data: uPlot.AlignedData;
}

const AXIS_PX = { x: 22, y: 44 };

/** A live plot; it is made anew when its series or the appearance change. */
export function Plot({ label, series, data }: PlotProps) {
  const root = useRef<HTMLDivElement>(null);
  const plot = useRef<uPlot | null>(null);
  const key = `${series.map((each) => each.label + each.color).join()} ${theme()}`;
  useEffect(() => {
    const element = root.current;
    if (!element) return;
    const made = new uPlot(options(series, element), data, element);
    plot.current = made;
    const observer = new ResizeObserver(() =>
      made.setSize({ width: element.clientWidth, height: element.clientHeight }),
    );
    observer.observe(element);
    return () => {
      observer.disconnect();
      made.destroy();
    };
  }, [key]);
  useEffect(() => plot.current?.setData(data), [data]);
  return <div class="plot" ref={root} role="img" aria-label={label} />;
}

function options(series: readonly Series[], element: HTMLElement): uPlot.Options {
  const style = getComputedStyle(element);
  const line = style.getPropertyValue("--line").trim();
  const text = style.getPropertyValue("--text-3").trim();
  const axis: uPlot.Axis = {
    stroke: text,
    font: `11px ${style.fontFamily}`,
    grid: { stroke: line, width: 1 },
    ticks: { show: false },
  };
  return {
    width: element.clientWidth,
    height: element.clientHeight,
    padding: [8, 14, 0, 0],
    legend: { show: false },
    cursor: { show: false },
    scales: { x: { time: false }, y: { range: (_plot, _low, high) => [0, high > 0 ? high * 1.1 : 1] } },
    axes: [
      { ...axis, size: AXIS_PX.x, values: (_plot, splits) => splits.map((value) => `${value} s`) },
      { ...axis, size: AXIS_PX.y },
    ],
    series: [{}, ...series.map((each) => seriesOptions(each))],
  };
}

function seriesOptions({ label, color, isFilled }: Series): uPlot.Series {
  return {
    label,
    stroke: color,
    width: isFilled ? 0.5 : 1.75,
    points: { show: false },
    ...(isFilled ? { fill: color } : {}),
  };
}
