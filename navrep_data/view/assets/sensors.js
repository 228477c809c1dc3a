// The scan and the rings. Near things matter most: ranges are drawn on a square-root scale.
const sensor = meta.sensor;
const rayAngle = (i) => sensor.angle_min + i * sensor.angle_increment;
const wrap = (angle) => angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));
const nearness = (range) => Math.sqrt(Math.min(Math.max(range, 0), sensor.range_max) / sensor.range_max);
// Rays from the left (behind) over ahead to the right (behind).
const rayOrder = Array.from({ length: sensor.n_rays }, (_, i) => i).sort((i, j) => wrap(rayAngle(j)) - wrap(rayAngle(i)));
const RANGE_MARKS = [1, 5, 10, 25, 50, 100];
const ANGLE_MARKS = [[Math.PI, 'behind', 'left'], [Math.PI / 2, 'left', 'center'], [0, 'ahead', 'center'], [-Math.PI / 2, 'right', 'center'], [-Math.PI, 'behind', 'right']];

function drawPolar(ctx, w, h, scanAt, colourAt) {
  const cx = w / 2, cy = h / 2, size = Math.min(w, h) / 2 - 4;
  ctx.lineWidth = 1;
  for (const metres of RANGE_MARKS.filter((m) => m <= sensor.range_max)) {
    disc(ctx, cx, cy, size * nearness(metres));
    ctx.strokeStyle = palette.line;
    ctx.stroke();
  }
  ctx.beginPath();
  const points = [];
  for (let i = 0; i < sensor.n_rays; i++) {
    const range = scanAt(i), angle = rayAngle(i) + Math.PI / 2;
    const r = size * nearness(range > 0 ? range : 0);
    const x = cx + r * Math.cos(angle), y = cy - r * Math.sin(angle);
    ctx.lineTo(x, y);
    if (range > 0 && range < sensor.range_max) points.push([x, y, colourAt(i)]);
  }
  ctx.closePath();
  ctx.globalAlpha = 0.18;
  ctx.fillStyle = palette.ray;
  ctx.fill();
  ctx.globalAlpha = 1;
  for (const [x, y, colour] of points) {
    ctx.fillStyle = colour;
    ctx.fillRect(x - 0.8, y - 0.8, 1.6, 1.6);
  }
  ctx.fillStyle = palette.robot;
  ctx.beginPath();
  ctx.moveTo(cx, cy - 6);
  ctx.lineTo(cx + 4, cy + 4);
  ctx.lineTo(cx - 4, cy + 4);
  ctx.fill();
  let lowest = Infinity;
  for (const metres of RANGE_MARKS.filter((m) => m <= sensor.range_max)) {
    const y = cy - size * nearness(metres) + 11;
    if (lowest - y < 13) continue;
    label(ctx, metres + ' m', cx + 2, y);
    lowest = y;
  }
}

function angleMarks(ctx, x, w, y) {
  for (const [angle, text, align] of ANGLE_MARKS.filter(([angle]) => w > 230 || Math.abs(angle) < (w > 140 ? 3 : 1))) label(ctx, text, Math.min(Math.max(x + w * (0.5 - angle / (2 * Math.PI)), x), x + w), y, align);
}

function drawStrip(ctx, w, h, scanAt, colourAt) {
  const left = 30, bottom = 15, pw = w - left - 4, ph = h - bottom - 4;
  for (const metres of RANGE_MARKS.filter((m) => m <= sensor.range_max)) {
    const y = 4 + ph * (1 - nearness(metres));
    ctx.strokeStyle = palette.line;
    ctx.lineWidth = 1;
    line(ctx, left, y, left + pw, y);
    label(ctx, metres + ' m', left - 3, y + 4, 'right');
  }
  const bar = Math.max(1, pw * Math.abs(sensor.angle_increment) / (2 * Math.PI));
  for (const i of rayOrder) {
    const range = scanAt(i);
    if (!(range > 0)) continue;
    ctx.fillStyle = colourAt(i);
    const x = left + pw * (0.5 - wrap(rayAngle(i)) / (2 * Math.PI)), y = 4 + ph * (1 - nearness(range));
    ctx.globalAlpha = 0.2;
    ctx.fillRect(x, y, bar, 4 + ph - y);
    ctx.globalAlpha = 1;
    if (range < sensor.range_max) ctx.fillRect(x, y - 0.8, bar, 1.6);
  }
  angleMarks(ctx, left, pw, h - 3);
}

const ringsImage = document.createElement('canvas');
function rgb(colour) {
  const n = parseInt(colour.slice(1), 16);
  return [n >> 16, (n >> 8) & 255, n & 255];
}

// Cells in the data: angle by range, anticlockwise from ahead; on the page: left to right, near at the bottom.
function drawRings(ctx, w, h, packed, row) {
  const [sections, cells] = meta.rings.shape, left = 42, bottom = 15, pw = w - left - 4, ph = h - bottom - 4;
  ringsImage.width = sections;
  ringsImage.height = cells;
  const picture = ringsImage.getContext('2d'), image = picture.createImageData(sections, cells);
  const colours = ['ring-free', 'ring-unknown', 'ring-occupied', 'ring-unknown'].map((name) => rgb(palette[name]));
  const codes = packed.codes, from = row * sections * cells / 4;
  for (let s = 0; s < sections; s++) {
    const x = (sections / 2 - 1 - s + sections) % sections;
    for (let c = 0; c < cells; c++) {
      const k = s * cells + c, value = (codes[from + (k >> 2)] >> (2 * (k & 3))) & 3;
      const p = 4 * ((cells - 1 - c) * sections + x);
      [image.data[p], image.data[p + 1], image.data[p + 2]] = colours[value];
      image.data[p + 3] = 255;
    }
  }
  picture.putImageData(image, 0, 0);
  ctx.imageSmoothingEnabled = false;
  ctx.drawImage(ringsImage, left, 4, pw, ph);
  ctx.strokeStyle = palette.line;
  ctx.strokeRect(left + 0.5, 4.5, pw - 1, ph - 1);
  for (const cell of [1, 16, 32, 48, 63]) {
    const y = 4 + ph * (1 - cell / cells);
    label(ctx, meta.rings.edges[cell].toFixed(1) + ' m', left - 3, Math.max(y + 4, 12), 'right');
  }
  angleMarks(ctx, left, pw, h - 3);
}
