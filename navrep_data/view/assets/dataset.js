// The dataset page: sequences, their episodes, and the panels that follow the row.
class Sequence {
  constructor(entry, arrays) {
    Object.assign(this, { entry, arrays, corners: arrays.corners, rows: entry.rows, episodes: entry.episodes });
    this.world = entry.frame === 'world' && Boolean(arrays.robot_pose);
    this.radius = entry.radius || 0.2;
    this.episodeIndex = new Uint32Array(entry.rows);
    entry.episodes.forEach((e, k) => this.episodeIndex.fill(k, e.start, e.start + e.length));
    this.boxes = new Map();
  }

  episodeOf(row) { return this.episodes[this.episodeIndex[row]]; }
  scan(row, ray) { return this.arrays.scan.value(row, ray); }

  // What a ray hit, where the dataset has labels: 0 nothing, 1 static, 2 another robot, 3 and more a person.
  rayColour(row, ray) {
    const hit = this.arrays.scan_label ? this.arrays.scan_label.value(row, ray) : 0;
    return hit === 0 ? palette.ray : hit === 1 ? palette['obstacle-edge'] : hit === 2 ? palette.robot : palette.human;
  }

  pose(row) {
    if (!this.world) return [0, 0, 0];
    const p = this.arrays.robot_pose;
    return [p.value(0, row), p.value(1, row), p.value(2, row)];
  }

  state(row) {
    const s = this.arrays.robot_state;
    return s ? [0, 1, 2, 3, 4].map((k) => s.value(k, row)) : new Array(5).fill(NaN);
  }

  goal(row, pose) {
    const [x, y] = this.state(row), c = Math.cos(pose[2]), s = Math.sin(pose[2]);
    return [pose[0] + c * x - s * y, pose[1] + s * x + c * y];
  }

  humans(row) {
    const a = this.arrays, found = [];
    if (!a.human_x) return found;
    for (let k = 0; k < a.human_x.shape[0]; k++) {
      const x = a.human_x.value(k, row), y = a.human_y.value(k, row);
      if (!Number.isFinite(x)) continue;
      found.push({
        x, y, vx: a.human_vx.value(k, row), vy: a.human_vy.value(k, row), radius: a.human_radius.value(k, row),
        visible: a.human_visible.value(k, row) > 0, legX: a.leg_x ? a.leg_x.value(k, row) : NaN, legY: a.leg_y ? a.leg_y.value(k, row) : NaN,
      });
    }
    return found;
  }

  // The box around an episode's border, or around its obstacles, path and goal where there is none.
  bounds(episode) {
    if (!this.boxes.has(episode)) {
      const box = [Infinity, Infinity, -Infinity, -Infinity];
      const put = (x, y) => {
        if (!Number.isFinite(x + y)) return;
        box[0] = Math.min(box[0], x); box[1] = Math.min(box[1], y);
        box[2] = Math.max(box[2], x); box[3] = Math.max(box[3], y);
      };
      const corners = episode.polygons.reduce((a, b) => a + b, 0);
      for (let v = episode.corner; v < episode.corner + corners; v++) put(this.corners.value(0, v), this.corners.value(1, v));
      for (let r = episode.start; r < episode.start + episode.length; r++) {
        put(...this.pose(r));
        if (!corners) this.humans(r).forEach((human) => put(human.x, human.y));
      }
      put(...this.goal(episode.start, this.pose(episode.start)));
      this.boxes.set(episode, box);
    }
    return this.boxes.get(episode);
  }
}

let sequence = null;
const world = new World($('world'));
const player = new Player(showRow, () => {
  showPlayer(player);
  if (!player.playing && sequence) announce();
});
const whenLoaded = (draw) => (ctx, w, h) => { if (sequence) draw(ctx, w, h); };
const panels = [
  new Surface($('polar'), whenLoaded((ctx, w, h) => drawPolar(ctx, w, h, (i) => sequence.scan(player.row, i), (i) => sequence.rayColour(player.row, i)))),
  new Surface($('strip'), whenLoaded((ctx, w, h) => drawStrip(ctx, w, h, (i) => sequence.scan(player.row, i), (i) => sequence.rayColour(player.row, i)))),
  new Surface($('rings-canvas'), whenLoaded((ctx, w, h) => {
    if (sequence.arrays.rings) drawRings(ctx, w, h, sequence.arrays.rings, player.row);
    else label(ctx, 'no rings: the scan does not go all around', w / 2, h / 2, 'center');
  })),
  new Surface($('curves'), whenLoaded(drawCurves)),
];

// Rewards of 100 and of 0.01 on one axis.
const squash = (reward) => Math.asinh(reward / 0.1);
const CURVES = [['vx', 'a', 'm/s'], ['vy', 'b', 'm/s'], ['ω', 'c', 'rad/s']];
const curvesLeft = 34;

// An episode's last row has no action and no reward.
const acted = (episode) => (episode.event === 'none' ? episode.length : Math.max(episode.length - 1, 0));

function drawCurves(ctx, w, h) {
  const episode = sequence.episodeOf(player.row), { action, reward } = sequence.arrays;
  const left = curvesLeft, pw = w - left - 6, half = (h - 14) / 2, n = acted(episode);
  const x = (k) => left + pw * (k + 0.5) / Math.max(episode.length, 1);
  const plot = (top, height, low, high, marks, lines) => {
    const y = (v) => top + height * (1 - (v - low) / (high - low));
    for (const [value, text] of marks) {
      ctx.strokeStyle = palette.line;
      ctx.lineWidth = 1;
      line(ctx, left, y(value), left + pw, y(value));
      label(ctx, text, left - 4, y(value) + 4, 'right');
    }
    for (const [colour, get] of lines) {
      ctx.strokeStyle = palette[colour];
      ctx.lineWidth = 1.6;
      ctx.beginPath();
      let pen = false;
      for (let k = 0; k < n; k++) {
        const value = get(episode.start + k);
        if (!Number.isFinite(value)) pen = false;
        else if (pen) ctx.lineTo(x(k), y(value));
        else { ctx.moveTo(x(k), y(value)); pen = true; }
      }
      ctx.stroke();
    }
  };
  if (action) {
    let most = 1;
    for (let k = 0; k < n; k++) for (let d = 0; d < 3; d++) most = Math.max(most, Math.abs(action.value(d, episode.start + k)) || 0);
    const marks = [-most, 0, most].map((v) => [v, fixed(v, most < 10 ? 1 : 0)]);
    plot(6, half - 8, -most, most, marks, CURVES.map(([, colour], d) => [colour, (r) => action.value(d, r)]));
  }
  if (reward) {
    let low = -0.2, high = 0.2;
    for (let k = 0; k < n; k++) {
      const value = reward.at(episode.start + k) || 0;
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
    const top = 10 + half, height = half - 8, marks = [[0, '0']];
    for (const v of [low, high]) if (height * Math.abs(squash(v)) / (squash(high) - squash(low)) > 10) marks.push([squash(v), fixed(v, Math.abs(v) < 10 ? 1 : 0)]);
    plot(top, height, squash(low), squash(high), marks, [['ink', (r) => squash(reward.at(r))]]);
  }
  const cursor = x(player.row - episode.start);
  ctx.strokeStyle = palette.robot;
  ctx.lineWidth = 1.5;
  line(ctx, cursor, 2, cursor, h - 2);
}

function showRow(row) {
  if (!sequence) return;
  const s = sequence, k = s.episodeIndex[row], episode = s.episodes[k], step = row - episode.start;
  world.show(s, row);
  for (const panel of panels) panel.paint();
  $('slider').value = String(row);
  $('slider').setAttribute('aria-valuetext', `row ${row}, episode ${episode.episode}, step ${step}`);
  $('clock').textContent = `row ${row} of ${s.rows - 1} · episode ${episode.episode} · step ${step} of ${episode.length - 1} · ${(step * player.dt).toFixed(1)} s`;
  const state = s.state(row), people = s.humans(row), seen = people.filter((human) => human.visible).length;
  const parts = [`goal ${fixed(Math.hypot(state[0], state[1]), 1)} m away`, `speed ${fixed(Math.hypot(state[2], state[3]), 2)} m/s`];
  if (people.length) parts.push(`${people.length} people, ${seen} seen`);
  $('state').textContent = parts.join(' · ');
  $('badge').textContent = `episode ${episode.episode}: ${OUTCOME_TEXT[known(episode.event)]}`;
  $('badge').style.borderColor = outcomeColour(episode.event);
  showLegend(row, episode, step);
  markEpisode(k);
}

function showLegend(row, episode, step) {
  const { action, reward } = sequence.arrays, means = step < acted(episode), items = [];
  CURVES.forEach(([name, colour, unit], d) => items.push(key(palette[colour], `${name} ${means && action ? fixed(action.value(d, row), 2) : '–'} ${unit}`)));
  items.push(key(palette.ink, `reward ${means && reward ? fixed(reward.at(row), 2) : '–'}`));
  $('curves-legend').replaceChildren(...items);
}

let marked = -1;
function markEpisode(k) {
  const buttons = $('timeline').children;
  if (k === marked || !buttons[k]) return;
  if (buttons[marked]) {
    buttons[marked].removeAttribute('aria-current');
    buttons[marked].tabIndex = -1;
  }
  buttons[k].setAttribute('aria-current', 'true');
  buttons[k].tabIndex = 0;
  marked = k;
}

function announce() {
  $('live').textContent = $('clock').textContent + '. ' + $('state').textContent;
}

function goToEpisode(k) {
  const episode = sequence.episodes[Math.min(Math.max(k, 0), sequence.episodes.length - 1)];
  player.seek(episode.start);
  if (!player.playing) announce();
}
const previousEpisode = () => {
  const k = sequence.episodeIndex[player.row];
  // as music players do: first back to this one's start
  goToEpisode(player.row > sequence.episodes[k].start + 3 ? k : k - 1);
};
const nextEpisode = () => goToEpisode(sequence.episodeIndex[player.row] + 1);

function buildTimeline() {
  marked = -1;
  $('timeline').replaceChildren(...sequence.episodes.map((episode, k) => {
    const text = `Episode ${episode.episode}: ${OUTCOME_TEXT[known(episode.event)]}, ${episode.length} rows`;
    const button = el('button', { type: 'button', 'aria-label': text, title: text, tabindex: -1, onclick: () => goToEpisode(k) }, OUTCOME_LETTER[known(episode.event)]);
    button.style.flex = `${episode.length} 1 0`;
    return button;
  }));
  colourTimeline();
}

function colourTimeline() {
  if (!sequence) return;
  [...$('timeline').children].forEach((button, k) => { button.style.background = outcomeColour(sequence.episodes[k].event); });
  const counts = OUTCOMES.map((name) => [name, sequence.episodes.filter((e) => known(e.event) === name).length]).filter(([, n]) => n);
  $('outcomes').replaceChildren(...counts.map(([name, n]) => key(outcomeColour(name), `${OUTCOME_LETTER[name]} ${OUTCOME_TEXT[name]} ${n}`)));
  $('rings-legend').replaceChildren(...[['free', 'ring-free'], ['unknown', 'ring-unknown'], ['occupied', 'ring-occupied']].map(([text, c]) => key(palette[c], text)));
  const hits = sequence.arrays.scan_label ? [['static', 'obstacle-edge'], ['robot', 'robot'], ['person', 'human']] : [];
  $('scan-legend').replaceChildren(...hits.map(([text, c]) => key(palette[c], text)));
}

async function loadSequence(index) {
  const entry = meta.sequences[index];
  player.pause();
  sequence = new Sequence(entry, await unpack(entry));
  $('slider').max = String(entry.rows - 1);
  buildTimeline();
  player.load(entry.rows, sensor.dt, 0);
  document.body.dataset.ready = String(entry.sequence);
}

function press(button, value) {
  button.setAttribute('aria-pressed', String(value));
  showRow(player.row);
}
function toggleFollow() { world.follow = !world.follow; world.zoom = 1; press($('follow'), world.follow); }
function toggleRays() { world.rays = !world.rays; press($('rays'), world.rays); }
function zoomBy(factor) { world.zoom = Math.min(Math.max(world.zoom * factor, 0.2), 12); showRow(player.row); }

function start() {
  startHelp();
  meta.sequences.forEach((entry, k) => {
    const part = entry.rows < entry.total ? `, ${entry.rows} of ${entry.total} rows` : '';
    $('sequence').append(el('option', { value: k }, `${entry.sequence} (${entry.episodes.length} episodes${part})`));
  });
  $('sequence').addEventListener('change', () => loadSequence(Number($('sequence').value)).catch(fatal));
  bindPlayer(player, { n: nextEpisode, p: previousEpisode, f: toggleFollow, r: toggleRays, '+': () => zoomBy(1.25), '=': () => zoomBy(1.25), '-': () => zoomBy(0.8) });
  $('next').addEventListener('click', nextEpisode);
  $('previous').addEventListener('click', previousEpisode);
  $('follow').addEventListener('click', toggleFollow);
  $('rays').addEventListener('click', toggleRays);
  $('zoom-in').addEventListener('click', () => zoomBy(1.25));
  $('zoom-out').addEventListener('click', () => zoomBy(0.8));
  $('world').addEventListener('wheel', (event) => { event.preventDefault(); zoomBy(event.deltaY < 0 ? 1.15 : 1 / 1.15); }, { passive: false });
  $('curves').addEventListener('pointerdown', (event) => {
    if (!sequence) return;
    const episode = sequence.episodeOf(player.row), box = $('curves').getBoundingClientRect();
    const share = (event.clientX - box.left - curvesLeft) / (box.width - curvesLeft - 6);
    player.seek(episode.start + Math.min(Math.max(Math.floor(share * episode.length), 0), episode.length - 1));
  });
  window.addEventListener('themechange', () => { colourTimeline(); if (sequence) showRow(player.row); });
  startTheme();
  showPlayer(player);
  loadSequence(0).catch(fatal);
}
start();
