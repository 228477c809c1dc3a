// A canvas that keeps its size in device pixels and redraws when its box, the theme or the data change.
class Surface {
  constructor(canvas, draw) {
    this.canvas = canvas;
    this.draw = draw;
    this.ctx = canvas.getContext('2d');
    this.width = this.height = 0;
    new ResizeObserver(() => this.paint()).observe(canvas);
    window.addEventListener('themechange', () => this.paint());
  }

  paint() {
    const box = this.canvas.getBoundingClientRect();
    const ratio = Math.min(window.devicePixelRatio || 1, 3);
    const w = Math.max(1, Math.round(box.width * ratio)), h = Math.max(1, Math.round(box.height * ratio));
    if (this.canvas.width !== w || this.canvas.height !== h) {
      this.canvas.width = w;
      this.canvas.height = h;
    }
    this.width = box.width;
    this.height = box.height;
    const ctx = this.ctx;
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, box.width, box.height);
    ctx.globalAlpha = 1;
    ctx.font = '11px system-ui, sans-serif';
    if (box.width > 10 && box.height > 10) this.draw(ctx, box.width, box.height);
  }
}

function disc(ctx, x, y, r) {
  ctx.beginPath();
  ctx.arc(x, y, Math.max(r, 0.1), 0, 2 * Math.PI);
}

function star(ctx, x, y, r) {
  ctx.beginPath();
  for (let k = 0; k < 10; k++) {
    const radius = k % 2 ? 0.45 * r : r, angle = Math.PI * (k / 5 - 0.5);
    ctx.lineTo(x + radius * Math.cos(angle), y + radius * Math.sin(angle));
  }
  ctx.closePath();
}

function line(ctx, x0, y0, x1, y1) {
  ctx.beginPath();
  ctx.moveTo(x0, y0);
  ctx.lineTo(x1, y1);
  ctx.stroke();
}

function label(ctx, text, x, y, align = 'left', colour = palette.muted) {
  ctx.fillStyle = colour;
  ctx.textAlign = align;
  ctx.fillText(text, x, y);
}

// Metres to pixels: `fit` shows a box whole, `around` shows `radius` metres about a point.
class Camera {
  around(x, y, radius, w, h) {
    this.scale = Math.min(w, h) / (2 * radius);
    this.cx = x;
    this.cy = y;
    this.w = w;
    this.h = h;
  }

  fit([x0, y0, x1, y1], w, h, zoom = 1) {
    const margin = 18;
    this.around((x0 + x1) / 2, (y0 + y1) / 2, 1, w, h);
    this.scale = zoom * Math.min((w - margin) / Math.max(x1 - x0, 0.5), (h - margin) / Math.max(y1 - y0, 0.5));
  }

  x(x) { return this.w / 2 + (x - this.cx) * this.scale; }
  y(y) { return this.h / 2 - (y - this.cy) * this.scale; }
  metres(px, py) { return [this.cx + (px - this.w / 2) / this.scale, this.cy - (py - this.h / 2) / this.scale]; }
}

function scaleBar(ctx, camera, w, h) {
  const most = 0.3 * w / camera.scale;
  const metres = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100].filter((m) => m <= most).pop();
  if (!metres) return;
  const length = metres * camera.scale;
  ctx.strokeStyle = palette.ink;
  ctx.lineWidth = 1.5;
  line(ctx, 10, h - 10, 10 + length, h - 10);
  line(ctx, 10, h - 13, 10, h - 7);
  line(ctx, 10 + length, h - 13, 10 + length, h - 7);
  label(ctx, metres + ' m', 10 + length / 2, h - 15, 'center', palette.ink);
}
