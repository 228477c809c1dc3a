// The results page: policies, scenarios, and the trajectories of one scenario, played together.
const state = { policy: 0, scenario: 0, chosen: -1, hidden: new Set(), arrays: null, episodes: [] };
const camera = new Camera();
const player = new Player(showStep, () => showPlayer(player));
const map = new Surface($('map'), (ctx, w, h) => { if (state.arrays) drawMap(ctx, w, h); });

// An episode's points are evenly spaced in time: where it was at a step.
function place(episode, step) {
  const { xy } = state.arrays, last = episode.points - 1;
  const share = episode.steps > 0 ? Math.min(step / episode.steps, 1) * last : last;
  const k = Math.min(Math.floor(share), Math.max(last - 1, 0)), rest = last > 0 ? share - k : 0;
  const a = episode.at + k, b = Math.min(a + 1, episode.at + last);
  return [0, 1].map((axis) => xy.value(axis, a) * (1 - rest) + xy.value(axis, b) * rest);
}

const shown = () => state.episodes.filter((e) => e.points > 0 && !state.hidden.has(known(e.event)));
const afterContact = (e) => known(e.event) === 'goal' && e.touched > 0;
const outcomeText = (e) => OUTCOME_TEXT[known(e.event)] + (afterContact(e) ? ' after contact' : '');
const count = (episodes, name) => episodes.filter((e) => known(e.event) === name).length;

function bounds() {
  const scene = meta.scenarios[state.scenario].scene, box = [Infinity, Infinity, -Infinity, -Infinity];
  const put = (x, y) => {
    if (!Number.isFinite(x + y)) return;
    box[0] = Math.min(box[0], x); box[1] = Math.min(box[1], y); box[2] = Math.max(box[2], x); box[3] = Math.max(box[3], y);
  };
  if (scene) for (const [x, y] of [...scene.start, ...scene.goal, ...scene.humans]) put(x, y);
  for (const e of state.episodes) for (let k = e.at; k < e.at + e.points; k++) put(state.arrays.xy.value(0, k), state.arrays.xy.value(1, k));
  if (!Number.isFinite(box[0])) return [-1, -1, 1, 1];
  return [box[0] - 1, box[1] - 1, box[2] + 1, box[3] + 1];
}

const maps = new Map();
function mapImage(index) {
  const name = index + document.documentElement.dataset.theme;
  if (!maps.has(name)) {
    const { codes, shape: [height, width] } = state.maps['map_' + index];
    const canvas = document.createElement('canvas');
    canvas.width = width;
    canvas.height = height;
    const picture = canvas.getContext('2d'), image = picture.createImageData(width, height), n = parseInt(palette.obstacle.slice(1), 16);
    for (let k = 0; k < codes.length; k++) if (codes[k]) image.data.set([n >> 16, (n >> 8) & 255, n & 255, 255], 4 * k);
    picture.putImageData(image, 0, 0);
    maps.set(name, canvas);
  }
  return maps.get(name);
}

function drawScene(ctx) {
  const scene = meta.scenarios[state.scenario].scene;
  if (!scene) return;
  if (scene.map !== null) {
    const [x0, y0, x1, y1] = scene.extent;
    ctx.imageSmoothingEnabled = false;
    ctx.drawImage(mapImage(scene.map), camera.x(x0), camera.y(y1), (x1 - x0) * camera.scale, (y1 - y0) * camera.scale);
  }
  ctx.strokeStyle = palette.human;
  ctx.lineWidth = 1.3;
  for (const [x, y] of scene.humans) {
    disc(ctx, camera.x(x), camera.y(y), Math.max(0.3 * camera.scale, 3));
    ctx.stroke();
  }
  ctx.fillStyle = palette.robot;
  for (const [x, y] of scene.start) {
    disc(ctx, camera.x(x), camera.y(y), 5);
    ctx.fill();
  }
  ctx.fillStyle = palette.goal;
  for (const [x, y] of scene.goal) {
    star(ctx, camera.x(x), camera.y(y), 10);
    ctx.fill();
  }
}

function drawMap(ctx, w, h) {
  camera.fit(bounds(), w, h);
  drawScene(ctx);
  const step = player.row, atEnd = step >= player.rows - 1;
  for (const e of shown()) {
    const chosen = state.chosen === e.number, faint = state.chosen >= 0 && !chosen;
    ctx.strokeStyle = ctx.fillStyle = outcomeColour(e.event);
    ctx.globalAlpha = faint ? 0.12 : chosen ? 1 : 0.7;
    ctx.lineWidth = chosen ? 3 : 1.5;
    ctx.setLineDash(afterContact(e) ? [5, 4] : []);
    ctx.beginPath();
    const now = atEnd ? e.points - 1 : Math.floor(Math.min(step / Math.max(e.steps, 1), 1) * (e.points - 1));
    for (let k = e.at; k <= e.at + now; k++) ctx.lineTo(camera.x(state.arrays.xy.value(0, k)), camera.y(state.arrays.xy.value(1, k)));
    const [x, y] = place(e, atEnd ? Infinity : step).map((v, axis) => (axis ? camera.y(v) : camera.x(v)));
    ctx.lineTo(x, y);
    ctx.stroke();
    ctx.setLineDash([]);
    disc(ctx, camera.x(state.arrays.xy.value(0, e.at)), camera.y(state.arrays.xy.value(1, e.at)), 3);
    ctx.stroke();
    mark(ctx, x, y, chosen ? 6 : 4, atEnd || step >= e.steps ? known(e.event) : 'moving');
    ctx.globalAlpha = 1;
  }
  scaleBar(ctx, camera, w, h);
  if (!shown().length) label(ctx, 'no trajectories kept or shown here', w / 2, h / 2, 'center');
}

// The end of a path by shape as well as colour: disc = goal, cross = collision, square = anything else.
function mark(ctx, x, y, r, event) {
  if (event.startsWith('collision')) {
    line(ctx, x - r, y - r, x + r, y + r);
    line(ctx, x - r, y + r, x + r, y - r);
  } else if (event === 'goal' || event === 'moving') {
    disc(ctx, x, y, event === 'goal' ? r : 0.8 * r);
    ctx.fill();
  } else ctx.fillRect(x - r, y - r, 2 * r, 2 * r);
}

function showStep(step) {
  map.paint();
  $('slider').value = String(step);
  $('slider').setAttribute('aria-valuetext', `step ${step}`);
  $('clock').textContent = `step ${step} of ${player.rows - 1} · ${(step * player.dt).toFixed(1)} s`;
}

function metricText([name, value]) {
  const unit = Object.hasOwn(meta.units, name) ? ` ${meta.units[name]}` : '';
  return `${name.replaceAll('_', ' ')} ${String(value).replace('-', '−')}${unit}`;
}

function showChosen() {
  const e = state.episodes.find((one) => one.number === state.chosen);
  $('badge').hidden = !e;
  if (e) {
    $('badge').textContent = `episode ${e.number}: ${outcomeText(e)}`;
    $('badge').style.borderColor = outcomeColour(e.event);
    const kept = e.points ? '' : ' · its trajectory was not kept';
    $('state').textContent = [`seed ${e.seed}`, `${e.steps} steps`, ...e.metrics.map(metricText)].join(' · ') + kept;
  } else {
    const kept = state.episodes.filter((one) => one.points).length;
    $('state').textContent = `${state.episodes.length} episodes, ${kept} with a trajectory`;
  }
  for (const button of $('timeline').children) {
    if (Number(button.dataset.episode) === state.chosen) button.setAttribute('aria-current', 'true');
    else button.removeAttribute('aria-current');
  }
  map.paint();
}

function choose(number) {
  state.chosen = state.chosen === number ? -1 : number;
  showChosen();
  $('live').textContent = $('badge').hidden ? 'all episodes' : $('badge').textContent;
}

function shareBar(episodes) {
  return el('span', { class: 'share', 'aria-hidden': 'true' }, ...OUTCOMES.map((name) => {
    const part = el('span', { colour: outcomeColour(name) });
    part.style.flex = `${count(episodes, name)} 1 0`;
    part.hidden = !count(episodes, name);
    return part;
  }));
}

function rowButton(text, episodes, pressed, onclick) {
  const percent = (n) => (episodes.length ? (100 * n / episodes.length).toFixed(1) : '–');
  const goals = count(episodes, 'goal'), free = goals - episodes.filter(afterContact).length;
  return el('button', { type: 'button', class: 'rowbutton', 'aria-pressed': pressed, onclick }, el('span', {}, text),
    el('small', { title: 'success contact-free, and as released' }, `${percent(free)} / ${percent(goals)} % of ${episodes.length}`), shareBar(episodes));
}

const ofScenario = (policy, scenario) => policy.table.filter((e) => e.scenario === scenario);

function buildLists() {
  $('policies').replaceChildren(...meta.policies.map((policy, k) => rowButton(policy.name, policy.table, k === state.policy, () => select(k, state.scenario))));
  $('scenarios').replaceChildren(...meta.scenarios.map((scenario, k) => rowButton(scenario.name, ofScenario(meta.policies[state.policy], k), k === state.scenario, () => select(state.policy, k))));
  $('timeline').replaceChildren(...state.episodes.map((e) => {
    const text = `Episode ${e.number}: ${outcomeText(e)}, ${e.steps} steps`;
    const button = el('button', { type: 'button', 'aria-label': text, title: text, 'data-episode': e.number, colour: outcomeColour(e.event), onclick: () => choose(e.number) }, state.episodes.length > 80 ? '' : OUTCOME_LETTER[known(e.event)]);
    button.style.flex = '1 1 0';
    return button;
  }));
  const there = OUTCOMES.filter((name) => count(state.episodes, name));
  $('filters').replaceChildren(...there.map((name) => el('button', {
    type: 'button', 'aria-pressed': !state.hidden.has(name), title: 'Show or hide',
    onclick: () => { if (!state.hidden.delete(name)) state.hidden.add(name); buildLists(); },
  }, OUTCOME_TEXT[name])));
  const touched = state.episodes.filter(afterContact).length;
  $('outcomes').replaceChildren(...there.map((name) => key(outcomeColour(name), `${OUTCOME_LETTER[name]} ${OUTCOME_TEXT[name]} ${count(state.episodes, name)}${name === 'goal' && touched ? ` (dashed: ${touched} after contact)` : ''}`)));
  showChosen();
}

async function select(policy, scenario) {
  const entry = meta.policies[policy];
  state.maps = meta.maps ? await unpack(meta.maps) : {};
  state.arrays = await unpack(entry);
  Object.assign(state, { policy, scenario, chosen: -1, episodes: ofScenario(entry, scenario) });
  player.pause();
  const longest = state.episodes.reduce((most, e) => Math.max(most, e.steps), 0);
  $('slider').max = String(longest);
  buildLists();
  player.load(longest + 1, meta.dt, longest);
  document.body.dataset.ready = `${policy}/${scenario}`;
}
const go = (policy, scenario) => select(policy, Math.min(Math.max(scenario, 0), meta.scenarios.length - 1)).catch(fatal);

// Episodes travel as columns; here they become records.
function readTables() {
  for (const policy of meta.policies) {
    const c = policy.columns;
    let at = 0;
    policy.table = c.number.map((number, k) => {
      const metrics = Object.entries(c.metrics).map(([name, values]) => [name, values[k]]).filter(([, value]) => value !== null);
      const e = { number, scenario: c.scenario[k], event: c.event[k], steps: c.steps[k], seed: c.seed[k], touched: c.touched[k], points: c.points[k], at, metrics };
      at += e.points;
      return e;
    });
  }
}

function clickMap(event) {
  const box = $('map').getBoundingClientRect(), px = event.clientX - box.left, py = event.clientY - box.top;
  let best = 12, found = -1;
  for (const e of shown()) for (let k = e.at; k < e.at + e.points; k++) {
    const away = Math.hypot(camera.x(state.arrays.xy.value(0, k)) - px, camera.y(state.arrays.xy.value(1, k)) - py);
    if (away < best) { best = away; found = e.number; }
  }
  state.chosen = found;
  showChosen();
}

function start() {
  startHelp();
  readTables();
  const nextScenario = () => go(state.policy, state.scenario + 1), previousScenario = () => go(state.policy, state.scenario - 1);
  bindPlayer(player, { n: nextScenario, p: previousScenario, Escape: () => { state.chosen = -1; showChosen(); } });
  $('next').addEventListener('click', nextScenario);
  $('previous').addEventListener('click', previousScenario);
  $('map').addEventListener('click', clickMap);
  window.addEventListener('themechange', () => { if (state.arrays) buildLists(); });
  startTheme();
  showPlayer(player);
  go(0, 0);
}
start();
