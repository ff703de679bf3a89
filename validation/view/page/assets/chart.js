// Axes on a canvas: scales, ticks, labels, and lines with bands in the units of the data.

export const INK = "#1c2530", SOFT = "#56616e", LINE = "#dfe3e8", BLUE = "#0072b2", ALARM = "#b3261e", UNSEEN = "#d9d9d9";
const BAND = "rgba(0, 114, 178, .25)";
const FONT = "12px system-ui, sans-serif";

export class Chart {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
  }

  // Clear the canvas and draw axes over two ranges; `right` leaves room beside them. Returns whether there is room.
  begin(x, y, labels, right = 12) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const dots = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(width * dots);
    this.canvas.height = Math.round(height * dots);
    this.pen.scale(dots, dots);
    this.left = 60;
    this.right = width - right;
    this.top = 8;
    this.bottom = height - 34;
    [this.x, this.y] = [x, y];
    if (this.right - this.left < 30 || this.bottom - this.top < 30) return false;
    this.ticks(x, y, labels);
    return true;
  }

  px(value) {
    return this.left + ((value - this.x[0]) / (this.x[1] - this.x[0])) * (this.right - this.left);
  }

  py(value) {
    return this.bottom - ((value - this.y[0]) / (this.y[1] - this.y[0])) * (this.bottom - this.top);
  }

  ticks(x, y, labels) {
    const pen = this.pen;
    [pen.font, pen.fillStyle, pen.strokeStyle, pen.lineWidth] = [FONT, SOFT, LINE, 1];
    pen.textAlign = "center";
    for (const [value, text] of ticks(x, (this.right - this.left) / 60)) {
      this.rule(this.px(value), this.top, this.px(value), this.bottom);
      pen.fillText(text, this.px(value), this.bottom + 14);
    }
    pen.fillText(labels[0], (this.left + this.right) / 2, this.bottom + 29);
    pen.textAlign = "right";
    for (const [value, text] of ticks(y, (this.bottom - this.top) / 36)) {
      this.rule(this.left, this.py(value), this.right, this.py(value));
      pen.fillText(text, this.left - 5, this.py(value) + 4);
    }
    pen.save();
    pen.translate(11, (this.top + this.bottom) / 2);
    pen.rotate(-Math.PI / 2);
    pen.textAlign = "center";
    pen.fillText(labels[1], 0, 0);
    pen.restore();
  }

  rule(x0, y0, x1, y1) {
    this.pen.beginPath();
    this.pen.moveTo(x0, y0);
    this.pen.lineTo(x1, y1);
    this.pen.stroke();
  }

  path(points) {
    this.pen.beginPath();
    points.forEach(([x, y]) => this.pen.lineTo(this.px(x), this.py(y)));
  }

  // Draw an interval between two points.
  bar(low, high) {
    [this.pen.strokeStyle, this.pen.lineWidth] = [BAND, 3];
    this.path([low, high]);
    this.pen.stroke();
  }

  // Draw text with a pale rim, to be read over lines.
  words(text, x, y) {
    [this.pen.strokeStyle, this.pen.lineWidth] = ["#fff", 4];
    this.pen.strokeText(text, x, y);
    this.pen.fillText(text, x, y);
  }

  // Draw a line through points, and fill between two others.
  curve(points, low = [], high = []) {
    const pen = this.pen;
    pen.save();
    pen.beginPath();
    pen.rect(this.left, this.top, this.right - this.left, this.bottom - this.top);
    pen.clip();
    [pen.fillStyle, pen.strokeStyle, pen.lineWidth, pen.lineJoin] = [BAND, BLUE, 2, "round"];
    this.path([...low, ...[...high].reverse()]);
    pen.fill();
    this.path(points);
    pen.stroke();
    pen.restore();
  }

  dot(x, y, colour = BLUE) {
    const pen = this.pen;
    [pen.fillStyle, pen.strokeStyle, pen.lineWidth] = [colour, "#fff", 2];
    pen.beginPath();
    pen.arc(this.px(x), this.py(y), 5.5, 0, 2 * Math.PI);
    pen.fill();
    pen.stroke();
  }
}

// Return ticks (value, text) at round numbers within a range, some `count` of them.
export function ticks([low, high], count) {
  const least = (high - low) / Math.max(2, count);
  const decade = 10 ** Math.floor(Math.log10(least));
  const every = [1, 2, 5, 10].map((k) => k * decade).find((width) => width >= least * 0.999);
  const digits = Math.max(0, -Math.floor(Math.log10(every * 1.001)));
  const result = [];
  for (let k = Math.ceil(low / every - 1e-9); k * every <= high + 1e-9 * every; k++)
    result.push([k * every, (k * every || 0).toFixed(digits).replace("-", "−")]);
  return result;
}

// Return the range of numbers, those that are not known left out, with a little room, and at least so wide.
export function span(values, least, room = 0.06) {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (!Number.isFinite(value)) continue;
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  if (low > high) [low, high] = [0, 0];
  const more = Math.max((high - low) * room, (least - (high - low)) / 2);
  return [low - more, high + more];
}
