// What a record tells: its lines, one by one, and what follows from all of them.

export const WIDE = 1.96; // half of a 95 % interval, in standard deviations

export class Test {
  plan = null;
  steps = new Map(); // step: its line
  newest = null; // of the largest step; a late radiograph is not the newest
  heard = []; // when motions became known, s since 1970
  alarms = [];
  lost = [];
  over = null;

  add(line) {
    if (line.what === "plan") this.plan = line;
    if (line.what === "alarm") this.alarms.push(line);
    if (line.what === "lost") this.lost.push(line);
    if (line.what === "measurement") this.over = line;
    if (line.what !== "step") return;
    this.steps.set(line.step, line);
    this.heard.push(line.unix_s);
    if (!this.newest || line.step >= this.newest.step) this.newest = line;
  }

  get length() {
    const height = this.plan.height_mm;
    return height[height.length - 1] - height[0];
  }

  // heights between which the strains are, mm
  get middles() {
    const height = this.plan.height_mm;
    return height.slice(1).map((top, k) => (top + height[k]) / 2);
  }

  get inOrder() {
    return [...this.steps.values()].sort((a, b) => a.step - b.step);
  }

  // the usual time between two radiographs, s; none before there are three
  get interval() {
    const last = this.heard.slice(-10);
    if (last.length < 3) return null;
    const gaps = last.slice(1).map((time, k) => time - last[k]).sort((a, b) => a - b);
    return gaps[gaps.length >> 1];
  }

  // whether each planned radiograph has come or was lost; a right line may follow a wrong one of the table
  get complete() {
    const gone = this.lost.filter((line) => line.file !== "radiographs.csv").map((line) => line.step);
    return this.plan && new Set([...gone, ...this.steps.keys()]).size >= this.plan.steps;
  }
}

// Return a number with so many digits that its half-width has two that count.
export function withHalf(value, half) {
  if (value === null || half === null) return ["–", ""];
  const digits = Math.min(4, Math.max(0, 1 - Math.floor(Math.log10(half || 1))));
  return [signed(value.toFixed(digits)), half.toFixed(digits)];
}

// Return a time that has passed as a number and its unit.
export function passed(seconds) {
  const [unit, length] = [["days", 86400], ["h", 3600], ["min", 60]].find(([, length]) => seconds >= 3 * length) ?? ["s", 1];
  return [(seconds / length).toFixed(unit === "s" ? 1 : 0), `${unit} ago`];
}

export function signed(text) {
  return /^-0*\.?0*$/.test(text) ? text.slice(1) : text.replace("-", "−");
}
