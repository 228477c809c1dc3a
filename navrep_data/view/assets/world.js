// The world from above: what stands, who walks, what the lidar sees.
class World {
  constructor(canvas) {
    this.camera = new Camera();
    this.follow = true;
    this.rays = true;
    this.zoom = 1;
    this.surface = new Surface(canvas, (ctx, w, h) => { if (this.sequence) this.draw(ctx, w, h); });
  }

  show(sequence, row) {
    this.sequence = sequence;
    this.row = row;
    this.surface.paint();
  }

  draw(ctx, w, h) {
    const s = this.sequence, row = this.row, episode = s.episodeOf(row);
    const pose = s.pose(row);
    if (this.follow || !s.world) this.camera.around(pose[0], pose[1], 7 / this.zoom, w, h);
    else this.camera.fit(s.bounds(episode), w, h, this.zoom);
    if (this.rays) this.drawRays(ctx, s, row, pose);
    this.drawPolygons(ctx, s, episode);
    if (s.world) this.drawPath(ctx, s, episode, row);
    this.drawGoal(ctx, s, row, pose);
    this.drawHumans(ctx, s, row);
    this.drawRobot(ctx, s, pose);
    scaleBar(ctx, this.camera, w, h);
    if (!s.world) label(ctx, 'poses are not recorded: seen from the robot, ahead is right', 10, 14);
  }

  drawRays(ctx, s, row, pose) {
    const c = this.camera, points = [];
    ctx.beginPath();
    for (let i = 0; i < sensor.n_rays; i++) {
      const range = s.scan(row, i), angle = pose[2] + rayAngle(i);
      const reach = range > 0 ? range : 0;
      const x = c.x(pose[0] + reach * Math.cos(angle)), y = c.y(pose[1] + reach * Math.sin(angle));
      ctx.lineTo(x, y);
      if (range > 0 && range < sensor.range_max) points.push([x, y, s.rayColour(row, i)]);
    }
    ctx.closePath();
    ctx.fillStyle = palette.ray;
    ctx.globalAlpha = 0.13;
    ctx.fill();
    ctx.globalAlpha = 1;
    for (const [x, y, colour] of points) {
      ctx.fillStyle = colour;
      ctx.fillRect(x - 1, y - 1, 2, 2);
    }
  }

  drawPolygons(ctx, s, episode) {
    const c = this.camera;
    ctx.lineWidth = 1.5;
    ctx.strokeStyle = palette['obstacle-edge'];
    ctx.fillStyle = palette.obstacle;
    let corner = episode.corner;
    episode.polygons.forEach((count, k) => {
      ctx.beginPath();
      for (let v = corner; v < corner + count; v++) ctx.lineTo(c.x(s.corners.value(0, v)), c.y(s.corners.value(1, v)));
      ctx.closePath();
      corner += count;
      if (!(episode.border && k === episode.polygons.length - 1)) ctx.fill();
      ctx.stroke();
    });
  }

  drawPath(ctx, s, episode, row) {
    const c = this.camera, path = (from, to) => {
      ctx.beginPath();
      for (let r = from; r <= to; r++) {
        const [x, y] = s.pose(r);
        ctx.lineTo(c.x(x), c.y(y));
      }
      ctx.stroke();
    };
    ctx.strokeStyle = palette.robot;
    ctx.lineWidth = 1;
    ctx.globalAlpha = 0.35;
    ctx.setLineDash([2, 4]);
    path(row, episode.start + episode.length - 1);
    ctx.setLineDash([]);
    ctx.globalAlpha = 0.9;
    ctx.lineWidth = 2;
    path(episode.start, row);
    ctx.globalAlpha = 1;
  }

  drawGoal(ctx, s, row, pose) {
    const [gx, gy] = s.goal(row, pose);
    if (!Number.isFinite(gx)) return;
    const c = this.camera, w = c.w, h = c.h, x = c.x(gx), y = c.y(gy);
    ctx.fillStyle = palette.goal;
    if (x > 4 && x < w - 4 && y > 4 && y < h - 4) {
      star(ctx, x, y, 10);
      ctx.fill();
      label(ctx, 'goal', x, y + 21, 'center', palette.goal);
      return;
    }
    // outside: an arrow at the edge points to it
    const angle = Math.atan2(y - h / 2, x - w / 2);
    const reach = Math.min((w / 2 - 14) / Math.max(Math.abs(Math.cos(angle)), 1e-6), (h / 2 - 14) / Math.max(Math.abs(Math.sin(angle)), 1e-6));
    const ex = w / 2 + reach * Math.cos(angle), ey = h / 2 + reach * Math.sin(angle);
    ctx.beginPath();
    for (const turn of [0, 2.5, -2.5]) ctx.lineTo(ex + 9 * Math.cos(angle + turn), ey + 9 * Math.sin(angle + turn));
    ctx.closePath();
    ctx.fill();
    const away = Math.hypot(gx - pose[0], gy - pose[1]);
    label(ctx, 'goal ' + away.toFixed(1) + ' m', ex - 24 * Math.cos(angle), ey - 16 * Math.sin(angle) + 4, Math.cos(angle) > 0.3 ? 'right' : Math.cos(angle) < -0.3 ? 'left' : 'center', palette.goal);
  }

  drawHumans(ctx, s, row) {
    const c = this.camera;
    for (const human of s.humans(row)) {
      const x = c.x(human.x), y = c.y(human.y), r = human.radius * c.scale;
      disc(ctx, x, y, r);
      ctx.fillStyle = ctx.strokeStyle = palette.human;
      ctx.globalAlpha = human.visible ? 0.45 : 0.1;
      ctx.fill();
      ctx.globalAlpha = human.visible ? 1 : 0.6;
      ctx.lineWidth = 1.3;
      ctx.setLineDash(human.visible ? [] : [3, 3]);
      ctx.stroke();
      ctx.setLineDash([]);
      if (Math.hypot(human.vx, human.vy) > 0.02) line(ctx, x, y, c.x(human.x + human.vx), c.y(human.y + human.vy));
      ctx.globalAlpha = 1;
      ctx.fillStyle = palette.leg;
      if (Number.isFinite(human.legX)) for (const side of [1, -1]) {
        disc(ctx, c.x(human.x + side * human.legX), c.y(human.y + side * human.legY), Math.max(0.03 * c.scale, 1.5));
        ctx.fill();
      }
    }
  }

  drawRobot(ctx, s, pose) {
    const c = this.camera, x = c.x(pose[0]), y = c.y(pose[1]), r = Math.max(s.radius * c.scale, 3);
    disc(ctx, x, y, r);
    ctx.fillStyle = palette.robot;
    ctx.globalAlpha = 0.85;
    ctx.fill();
    ctx.globalAlpha = 1;
    ctx.strokeStyle = palette.robot;
    ctx.lineWidth = 2.5;
    line(ctx, x, y, x + 1.9 * r * Math.cos(pose[2]), y - 1.9 * r * Math.sin(pose[2]));
  }
}
