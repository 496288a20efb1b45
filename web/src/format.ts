// Numbers, sizes and times in words, in the reader's own language and time zone.

const SECOND_MS = 1000;

/** Keeps a number and its unit on one line. */
const NBSP = "\u00a0";

function decimals(value: number): number {
  return Math.abs(value) < 10 ? 2 : Math.abs(value) < 100 ? 1 : 0;
}

/** A number with about three digits that matter. */
export function number(value: number): string {
  return value.toLocaleString(undefined, { maximumFractionDigits: decimals(value) });
}

/** A whole number with its thousands apart. */
export function count(value: number): string {
  return Math.round(value).toLocaleString();
}

/** A file's size, bytes in, in powers of 1000 as file managers show it. */
export function size(bytes: number): string {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let value = bytes;
  let unit = 0;
  while (value >= 1000 && unit < units.length - 1) {
    value /= 1000;
    unit += 1;
  }
  return `${unit === 0 ? value : number(value)}${NBSP}${units[unit]}`;
}

/** A length, mm in: millimetres up to one metre, metres from there. */
export function lengthMm(mm: number): string {
  return Math.abs(mm) < 1000 ? `${number(mm)}${NBSP}mm` : `${number(mm / 1000)}${NBSP}m`;
}

/** A share of 0 to 1 as per cent. Only the whole is called 100 %, only nothing 0 %. */
export function percent(share: number): string {
  const value = share * 100;
  const tenths = (near: number) => near.toLocaleString(undefined, { minimumFractionDigits: 1, maximumFractionDigits: 1 }) + `${NBSP}%`;
  if (value > 99 && value < 100) return tenths(Math.min(value, 99.9));
  if (value > 0 && value < 1) return tenths(Math.max(value, 0.1));
  return `${Math.round(value)}${NBSP}%`;
}

/** A duration, seconds in: the two largest units. */
export function duration(seconds: number): string {
  if (seconds < 1) return "under 1 s";
  const whole = Math.round(seconds);
  if (whole < 60) return `${whole}${NBSP}s`;
  const minutes = Math.floor(whole / 60);
  if (minutes < 60) return whole % 60 === 0 || minutes >= 10 ? `${minutes}${NBSP}min` : `${minutes}${NBSP}min ${whole % 60}${NBSP}s`;
  const hours = Math.floor(minutes / 60);
  return minutes % 60 === 0 ? `${hours}${NBSP}h` : `${hours}${NBSP}h ${minutes % 60}${NBSP}min`;
}

/** A time of the server (RFC 3339) as local date and time; today only the time. */
export function localTime(rfc3339: string, now: Date = new Date()): string {
  const time = new Date(rfc3339);
  if (Number.isNaN(time.getTime())) return rfc3339;
  const clock: Intl.DateTimeFormatOptions = { hour: "2-digit", minute: "2-digit" };
  if (time.toDateString() === now.toDateString()) return `today ${time.toLocaleTimeString(undefined, clock)}`;
  return time.toLocaleString(undefined, { year: "numeric", month: "short", day: "numeric", ...clock });
}

/** The same time in UTC to the second, for those who compare logs. */
export function utcTime(rfc3339: string): string {
  const time = new Date(rfc3339);
  return Number.isNaN(time.getTime()) ? rfc3339 : `${time.toISOString().slice(0, 19).replace("T", " ")} UTC`;
}

/** Seconds between two times of the server; `to` may be missing while it goes on. */
export function secondsBetween(from: string, to: string | null | undefined): number {
  return ((to ? new Date(to).getTime() : Date.now()) - new Date(from).getTime()) / SECOND_MS;
}
