// Days as forms have them.

/** A form's day, or one so many days later, as the time when it begins here; empty where it is no day. */
export function dayStart(text: string, later: number): string {
  const start = new Date(`${text}T00:00:00`);
  if (text === "" || Number.isNaN(start.getTime())) return "";
  start.setDate(start.getDate() + later);
  return start.toISOString();
}
