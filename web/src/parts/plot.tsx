// A plot of lines over one axis, by uPlot, in the page's colours.

import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { useEffect, useRef } from "preact/hooks";

/** One line. */
export interface Series {
  label: string;
  values: (number | null)[];
  /** A colour of the style sheet, `--plot-1` and so on. */
  colour: string;
}

type Props = {
  x: number[];
  series: Series[];
  xLabel: string;
  yLabel: string;
  /** What it shows, for those who do not see it. */
  label: string;
  height?: number;
  /** Depths grow downwards, away from the eye. */
  flipped?: boolean;
  /** Hears the index of the value under the pointer. */
  onCursor?: (index: number | null) => void;
};

const HEIGHT_PX = 220;

export function Plot(props: Props) {
  const box = useRef<HTMLDivElement>(null);
  const newest = useRef(props);
  newest.current = props;
  const { x, series } = props;

  useEffect(() => {
    const element = box.current;
    if (element === null) return undefined;
    let plot: uPlot | null = null;
    const make = () => {
      plot?.destroy();
      plot = new uPlot(options(element, newest.current), [newest.current.x, ...newest.current.series.map(({ values }) => values)], element);
    };
    make();
    const resized = new ResizeObserver(() => plot?.setSize({ width: element.clientWidth, height: newest.current.height ?? HEIGHT_PX }));
    resized.observe(element);
    const scheme = matchMedia("(prefers-color-scheme: dark)");
    scheme.addEventListener("change", make);
    return () => {
      scheme.removeEventListener("change", make);
      resized.disconnect();
      plot?.destroy();
    };
  }, [x, series]);

  return <div ref={box} class="plot" role="img" aria-label={props.label} />;
}

function options(element: HTMLElement, { series, xLabel, yLabel, height, flipped, onCursor }: Props): uPlot.Options {
  const style = getComputedStyle(element);
  const of = (name: string) => style.getPropertyValue(name).trim();
  const axis = { stroke: of("--faint"), grid: { stroke: of("--grid"), width: 1 }, ticks: { stroke: of("--line"), width: 1 }, font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif" };
  return {
    width: element.clientWidth,
    height: height ?? HEIGHT_PX,
    scales: { x: { time: false }, y: flipped ? { dir: -1 } : {} },
    axes: [
      { ...axis, label: xLabel, space: 70, size: 26, labelGap: 0, labelSize: 18 },
      { ...axis, label: yLabel, size: 52, labelGap: 0, labelSize: 18 },
    ],
    series: [
      { label: xLabel, value: (_, value) => (value === null ? "–" : value.toLocaleString(undefined, { maximumFractionDigits: 2 })) },
      ...series.map(({ label, colour }) => ({
        label,
        stroke: of(colour),
        width: 1.5,
        points: { show: false },
        spanGaps: false,
        value: (_: uPlot, value: number | null) => (value === null ? "–" : value.toLocaleString(undefined, { maximumFractionDigits: 3 })),
      })),
    ],
    cursor: { drag: { x: true, y: false }, points: { size: 8 } },
    legend: { live: true, markers: { width: 3 } },
    hooks: onCursor ? { setCursor: [(plot) => onCursor(plot.cursor.idx ?? null)] } : {},
  };
}
