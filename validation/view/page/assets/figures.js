// The figures of the page: strain over step and height, strain now, mean strain, force and extension.

import { ALARM, Chart, INK, SOFT, UNSEEN, span, ticks } from "./chart.js";
import { colours } from "./colours.js";
import { WIDE } from "./record.js";

const HEIGHT = "height on the axis (mm)";
const charts = new Map();

function chart(id) {
  if (!charts.has(id)) charts.set(id, new Chart(document.getElementById(id)));
  return charts.get(id);
}

// null is what is not known
const percent = (value) => (value === null ? NaN : 100 * value);

export function drawAll(test) {
  const steps = test.inOrder;
  const limits = strainLimits(steps);
  drawMap(test, steps, limits);
  drawProfile(test, limits);
  drawCourse(test, steps);
  drawCurve(test, steps);
}

// Return the range of colours, %: of all strains so far, and never so narrow that noise alone fills it.
function strainLimits(steps) {
  const deviations = steps.flatMap((line) => line.strain_std.map(percent)).filter(Number.isFinite).sort((a, b) => a - b);
  const noise = deviations.length ? deviations[deviations.length >> 1] : 0.01;
  const [low, high] = span(steps.flatMap((line) => line.strain.map(percent)), 0, 0);
  return [Math.min(low, 0), Math.max(high, Math.min(low, 0) + 8 * noise)];
}

function drawMap(test, steps, [low, high]) {
  const map = chart("map"), height = test.plan.height_mm;
  if (!map.begin([-0.5, test.plan.steps - 0.5], [height[0], height[height.length - 1]], ["step", HEIGHT], 76)) return;
  const pen = map.pen;
  pen.fillStyle = UNSEEN;
  for (const line of test.lost) if (line.step >= 0) box(map, line.step, height[0], height[height.length - 1]);
  for (const line of steps)
    line.strain.forEach((value, k) => {
      pen.fillStyle = value === null ? UNSEEN : rgb((percent(value) - low) / (high - low));
      box(map, line.step, height[k], height[k + 1]);
    });
  for (const alarm of test.alarms) markAlarm(map, alarm);
  drawBar(map, low, high);
}

function box(map, step, bottom, top) {
  const [x, y] = [Math.floor(map.px(step - 0.5)), Math.floor(map.py(top))];
  map.pen.fillRect(x, y, Math.ceil(map.px(step + 0.5)) - x, Math.ceil(map.py(bottom)) - y);
}

function rgb(share) {
  const [red, green, blue] = colours.strain[Math.round(255 * Math.min(1, Math.max(0, share)))];
  return `rgb(${red} ${green} ${blue})`;
}

function drawBar(map, low, high) {
  const pen = map.pen, x = map.right + 14;
  for (let y = map.top; y < map.bottom; y++) {
    pen.fillStyle = rgb((map.bottom - y) / (map.bottom - map.top));
    pen.fillRect(x, y, 12, 1.5);
  }
  [pen.fillStyle, pen.textAlign] = [SOFT, "left"];
  for (const [value, text] of ticks([low, high], (map.bottom - map.top) / 36))
    pen.fillText(text, x + 16, map.bottom - ((value - low) / (high - low)) * (map.bottom - map.top) + 4);
  pen.fillText("strain (%)", map.right + 8, map.bottom + 14);
}

// Mark the step of an alarm at the top, and its place where it is known.
function markAlarm(map, alarm) {
  const pen = map.pen, x = map.px(alarm.step), z = alarm.place_mm?.[2] ?? null;
  [pen.fillStyle, pen.strokeStyle, pen.lineWidth] = [ALARM, "#fff", 1.5];
  pen.beginPath();
  [[x - 7, map.top - 8], [x + 7, map.top - 8], [x, map.top + 6]].forEach((point) => pen.lineTo(...point));
  pen.closePath();
  pen.fill();
  pen.stroke();
  if (z === null) return;
  for (const [colour, width] of [["#fff", 5], [ALARM, 2.5]]) {
    [pen.strokeStyle, pen.lineWidth] = [colour, width];
    pen.beginPath();
    pen.arc(x, map.py(z), 7, 0, 2 * Math.PI);
    pen.stroke();
  }
}

function drawProfile(test, limits) {
  const profile = chart("profile"), height = test.plan.height_mm, line = test.newest;
  const middles = test.middles;
  const known = line ? middles.map((_, k) => k).filter((k) => line.strain[k] !== null && line.strain_std[k] !== null) : [];
  const at = (side) => known.map((k) => [percent(line.strain[k] + side * WIDE * line.strain_std[k]), middles[k]]);
  const x = span([...limits, ...at(-1).map(([e]) => e), ...at(1).map(([e]) => e)], 0.1, 0.03);
  if (!profile.begin(x, [height[0], height[height.length - 1]], ["strain (%)", HEIGHT])) return;
  const pen = profile.pen;
  const places = test.alarms.filter((alarm) => (alarm.place_mm?.[2] ?? null) !== null).slice(-3);
  [pen.strokeStyle, pen.fillStyle, pen.lineWidth, pen.textAlign] = [ALARM, ALARM, 2, "right"];
  pen.setLineDash([6, 3]);
  for (const { place_mm } of places) profile.rule(profile.left, profile.py(place_mm[2]), profile.right, profile.py(place_mm[2]));
  pen.setLineDash([]);
  [pen.strokeStyle, pen.lineWidth] = [INK, 1];
  profile.rule(profile.px(0), profile.top, profile.px(0), profile.bottom);
  profile.curve(at(0), at(-1), at(1));
  // names beside each other, as places may be close together
  const apart = 0.34 * (profile.right - profile.left);
  [pen.fillStyle, pen.textAlign] = [ALARM, "right"];
  [...places].reverse().forEach(({ alarm, place_mm }, k) =>
    profile.words(alarm, profile.right - 4 - k * apart, profile.py(place_mm[2]) - 4));
}

function drawCourse(test, steps) {
  const course = chart("course");
  const known = steps.filter((line) => line.mean_strain !== null && line.mean_strain_std !== null);
  const at = (side) => known.map((line) => [line.step, percent(line.mean_strain + side * WIDE * line.mean_strain_std)]);
  const y = span([0, ...at(-1).map(([, e]) => e), ...at(1).map(([, e]) => e)], 0.02);
  if (!course.begin([0, Math.max(1, test.plan.steps - 1)], y, ["step", "mean strain (%)"])) return;
  const pen = course.pen;
  [pen.strokeStyle, pen.lineWidth] = [ALARM, 1.5];
  pen.setLineDash([6, 3]);
  for (const { step } of test.alarms) course.rule(course.px(step), course.top, course.px(step), course.bottom);
  pen.setLineDash([]);
  course.curve(at(0), at(-1), at(1));
  if (known.length) course.dot(...at(0).at(-1));
}

function drawCurve(test, steps) {
  const curve = chart("curve"), length = test.length;
  const known = steps.filter((line) => [line.mean_strain, line.mean_strain_std, line.force_N].every((v) => v !== null));
  const at = (side) =>
    known.map((line) => [(line.mean_strain + side * WIDE * line.mean_strain_std) * length, line.force_N]);
  const [low, middle, high] = [at(-1), at(0), at(1)];
  const x = span([0, ...low.map(([u]) => u), ...high.map(([u]) => u)], 0.002);
  const y = span(known.map((line) => line.force_N), 10);
  if (!curve.begin(x, y, ["extension (mm)", "force (N)"])) return;
  // a band would cross itself where the force hardly changes
  low.forEach((point, k) => curve.bar(point, high[k]));
  curve.curve(middle);
  if (known.length) curve.dot(...middle.at(-1));
  const raised = new Set(test.alarms.map((alarm) => alarm.step));
  known.forEach((line, k) => raised.has(line.step) && curve.dot(...middle[k], ALARM));
}

// Fill the scale of the residual's picture.
export function drawScale() {
  const pen = document.getElementById("scale").getContext("2d");
  colours.residual.forEach(([red, green, blue], k) => {
    pen.fillStyle = `rgb(${red} ${green} ${blue})`;
    pen.fillRect(k, 0, 1, 1);
  });
}
