// A long list of which only the rows near the window exist. Rows have one height, so the place of each is known.

import type { ComponentChildren } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";

/** Rows beyond the window that exist as well: scrolling finds them there. */
const BEYOND = 8;
/** So many rows before the end more are asked for. */
const NEAR_END = 30;

type Props<T> = {
  label: string;
  items: T[];
  /** Height of a row with its gap, px. */
  row: number;
  keyOf: (item: T) => string;
  onNearEnd: () => void;
  children: (item: T) => ComponentChildren;
};

export function VirtualList<T>({ label, items, row, keyOf, onNearEnd, children }: Props<T>) {
  const list = useRef<HTMLUListElement>(null);
  const [range, setRange] = useState<[number, number]>([0, 24]);
  useEffect(() => {
    let waiting = false;
    const look = () => {
      waiting = false;
      const box = list.current?.getBoundingClientRect();
      if (box === undefined) return;
      const first = Math.max(Math.floor(-box.top / row) - BEYOND, 0);
      const last = Math.ceil((innerHeight - box.top) / row) + BEYOND;
      setRange((before) => (before[0] === first && before[1] === last ? before : [first, last]));
    };
    const later = () => {
      if (waiting) return;
      waiting = true;
      requestAnimationFrame(look);
    };
    look();
    addEventListener("scroll", later, { passive: true });
    addEventListener("resize", later);
    return () => {
      removeEventListener("scroll", later);
      removeEventListener("resize", later);
    };
  }, [row]);
  const [first, last] = range;
  useEffect(() => {
    if (last > items.length - NEAR_END) onNearEnd();
  }, [last, items.length]);
  return (
    <ul ref={list} class="virtual" aria-label={label} style={{ height: `${items.length * row}px` }}>
      {items.slice(first, last).map((item, at) => (
        <li key={keyOf(item)} aria-setsize={items.length} aria-posinset={first + at + 1} style={{ transform: `translateY(${(first + at) * row}px)`, height: `${row}px` }}>
          {children(item)}
        </li>
      ))}
    </ul>
  );
}
