// The page: listens to the record's lines, and shows what they tell. Text of the record is only ever set as text.

import { drawAll, drawScale } from "./figures.js";
import { Test, WIDE, passed, signed, withHalf } from "./record.js";

const LATE = 3; // usual times between radiographs without one, from which on that is said
const CUT_OFF_MS = 5000; // without a sign of the server
const RETRY_MS = 2000;

const $ = (id) => document.getElementById(id);
let test = new Test();
let pictures = { step: null, lag_s: null, alarms: [] };
let ahead_s = 0; // the server's clock less ours
let heard_ms = 0;
let drawing = false;

function listen() {
  const source = new EventSource("events");
  const on = (name, act) =>
    source.addEventListener(name, (event) => {
      heard_ms = Date.now();
      act(event.data);
    });
  on("reset", () => begin());
  on("line", (text) => hear(text));
  on("pictures", (text) => show(text ? JSON.parse(text) : { step: null, lag_s: null, alarms: [] }));
  on("clock", (text) => {
    ahead_s = Number(text) - Date.now() / 1000;
    tick();
  });
  source.onerror = () => {
    heard_ms = Math.min(heard_ms, Date.now() - CUT_OFF_MS);
    tick();
    if (source.readyState !== EventSource.CLOSED) return;
    // the browser has given up: all is told again then
    setTimeout(() => {
      begin();
      listen();
    }, RETRY_MS);
  };
}

function begin() {
  test = new Test();
  redraw();
}

function hear(text) {
  try {
    test.add(JSON.parse(text));
  } catch {
    return; // a damaged line tells nothing
  }
  redraw();
}

// Draw once, however many lines came at a time.
function redraw() {
  if (drawing) return;
  drawing = true;
  // not by animation frames: these stop in a window that is hidden, and an alarm has to reach its title
  setTimeout(() => {
    drawing = false;
    if (test.plan) drawAll(test);
    tellNumbers();
    tellEvents();
    describe();
    tick();
  }, 30);
}

function tellNumbers() {
  const { plan, newest } = test;
  if (!plan) return;
  $("title").textContent = plan.title || "A test";
  $("steps").textContent = `of 0 to ${plan.steps - 1}`;
  $("progress").value = test.steps.size / Math.max(1, plan.steps);
  if (!newest) return;
  const [strain, strainHalf] = withHalf(by(newest.mean_strain, 100), by(newest.mean_strain_std, 100 * WIDE));
  const [extension, half] = withHalf(by(newest.mean_strain, test.length), by(newest.mean_strain_std, WIDE * test.length));
  $("force").textContent = fixed(newest.force_N, 0);
  $("time").textContent = `at ${fixed(newest.time_s, 1)} s, ${fixed(newest.angle_deg, 1)}°`;
  $("strain").textContent = strain;
  $("strain-half").textContent = strainHalf && `± ${strainHalf} %`;
  $("extension").textContent = extension;
  $("extension-half").textContent = half && `± ${half} mm`;
  $("step").textContent = newest.step;
  $("work").textContent = `work ${fixed(newest.seconds, 2)} s, χ² ${fixed(newest.chi2_reduced, 2)}`;
}

const by = (value, factor) => (value === null ? null : value * factor);
const fixed = (value, digits) => (value === null || value === undefined ? "–" : signed(value.toFixed(digits)));

// What depends on the time alone.
function tick() {
  const now_s = Date.now() / 1000 + ahead_s;
  const last_s = test.heard.at(-1);
  const since_s = last_s === undefined ? null : Math.max(0, now_s - last_s);
  const usual_s = test.interval;
  const running = since_s !== null && !test.over && !test.complete;
  [$("since").textContent, $("since-unit").textContent] = running ? passed(since_s) : ["–", ""];
  $("usual").textContent = usual_s === null ? "" : `usually ${usual_s.toFixed(1)} s`;
  const [state, words] = condition(since_s, usual_s);
  if ($("status").textContent === words && document.body.dataset.state === state) return;
  document.body.dataset.state = state;
  $("status").textContent = words;
}

function condition(since_s, usual_s) {
  const cutOff = heard_ms > 0 && Date.now() - heard_ms >= CUT_OFF_MS;
  if (test.over) return ["over", `test over: measurement in ${test.over.file}`];
  if (cutOff) return ["lost", "connection lost: trying again"];
  if (heard_ms === 0) return ["connecting", "connecting …"];
  if (since_s === null) return ["waits", "waiting for the first radiograph"];
  if (test.complete) return ["measures", "all radiographs are in: the whole test is being measured"];
  if (usual_s !== null && since_s > Math.max(2, LATE * usual_s)) return ["late", "no new radiograph for a while"];
  return ["follows", "following"];
}

function show(latest) {
  const { alarms } = pictures;
  pictures = latest;
  for (const name of ["radiograph", "residual"]) {
    const picture = $(name);
    picture.hidden = latest.step === null;
    if (latest.step !== null) picture.src = `pictures/${numbered(latest.step)}.${name}.png`;
  }
  for (const each of document.querySelectorAll(".pictured"))
    each.textContent = latest.step === null ? "" : `step ${latest.step}`;
  $("lag").textContent = fixed(latest.lag_s, 2);
  if (String(alarms) !== String(latest.alarms)) tellEvents();
}

const numbered = (step) => String(step).padStart(5, "0");

function tellEvents() {
  const last = test.alarms.at(-1);
  $("banner").hidden = !last;
  document.title = `${last ? "ALARM: " : ""}${test.plan?.title || "P-DVC live"}`;
  if (last) {
    const more = test.alarms.length > 1 ? ` (${test.alarms.length} alarms in all)` : "";
    tell($("banner"), ["strong", `⚠ ALARM ${last.alarm}`], ["span", `step ${last.step}: ${last.reason}${more}`]);
  }
  const items = [...test.alarms, ...test.lost].sort((a, b) => b.step - a.step).map(eventItem);
  const none = document.createElement("li");
  tell(none, ["span", "none so far"]);
  none.className = "none";
  $("events").replaceChildren(...(items.length ? items : [none]));
}

function eventItem(line) {
  const item = document.createElement("li");
  const alarm = line.what === "alarm";
  item.className = line.what;
  const step = line.step < 0 ? line.file : `step ${line.step}`;
  tell(item, ["b", alarm ? `⚠ ${line.alarm}` : "lost"], ["span", `${step}: ${line.reason}`]);
  if (alarm && pictures.alarms.includes(line.step)) item.append(shots(line.step));
  return item;
}

function shots(step) {
  const row = document.createElement("div");
  row.className = "shots";
  for (const name of ["radiograph", "residual"]) {
    const picture = document.createElement("img");
    picture.src = `pictures/alarms/${numbered(step)}.${name}.png`;
    picture.alt = `${name} of step ${step}`;
    row.append(picture);
  }
  return row;
}

// Fill an element with others that hold text; what stays the same is left, so that it is not read out again.
function tell(element, ...parts) {
  const words = parts.map(([, text]) => text).join(" ");
  if (element.dataset.words === words) return;
  element.dataset.words = words;
  const children = parts.map(([kind, text]) => {
    const child = document.createElement(kind);
    child.textContent = text;
    return child;
  });
  element.replaceChildren(...children);
}

// What the figures show, for those who cannot see them.
function describe() {
  if (!test.newest) return;
  const words = `step ${test.newest.step}: mean strain ${$("strain").textContent} %, force ${$("force").textContent} N`;
  for (const id of ["map", "profile", "course", "curve"])
    $(id).setAttribute("aria-label", `${$(id).previousElementSibling.textContent}; ${words}`);
}

new ResizeObserver(redraw).observe(document.body);
drawScale();
setInterval(tick, 250);
listen();
