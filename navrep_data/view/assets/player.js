// Time: rows that pass, by themselves or by hand.
const SPEEDS = [0.25, 0.5, 1, 2, 4, 8, 16];
const MOST_ROWS_PER_FRAME = 50;

class Player {
  constructor(onrow, onstate) {
    this.onrow = onrow;
    this.onstate = onstate;
    this.rows = 1;
    this.row = 0;
    this.dt = 0.2;
    this.speed = 2;
    this.playing = false;
    this.owed = 0;
    this.before = 0;
  }

  load(rows, dt, row = 0) {
    this.rows = Math.max(1, rows);
    this.dt = dt > 0.001 ? dt : 0.2;
    this.seek(row);
  }

  seek(row) {
    this.row = Math.min(Math.max(Math.round(row) || 0, 0), this.rows - 1);
    this.onrow(this.row);
  }

  step(by) {
    this.pause();
    this.seek(this.row + by);
  }

  toggle() {
    if (this.playing) this.pause();
    else this.play();
  }

  play() {
    if (this.row >= this.rows - 1) this.seek(0);
    this.playing = true;
    this.owed = 0;
    this.before = performance.now();
    this.onstate();
    requestAnimationFrame((now) => this.tick(now));
  }

  pause() {
    if (!this.playing) return;
    this.playing = false;
    this.onstate();
  }

  faster(by) {
    const at = SPEEDS.indexOf(this.speed) + by;
    this.speed = SPEEDS[Math.min(Math.max(at, 0), SPEEDS.length - 1)];
    this.onstate();
  }

  tick(now) {
    if (!this.playing) return;
    this.owed += Math.max(0, now - this.before) / 1000 * this.speed / this.dt;
    this.before = now;
    const rows = Math.min(Math.floor(this.owed), MOST_ROWS_PER_FRAME);
    if (rows > 0) {
      this.owed = Math.min(this.owed - rows, 1);
      this.seek(this.row + rows);
      if (this.row >= this.rows - 1) {
        this.pause();
        return;
      }
    }
    requestAnimationFrame((next) => this.tick(next));
  }
}

// Buttons, slider and keys that both pages have; `keys` are more of them.
function bindPlayer(player, keys) {
  for (const speed of SPEEDS) $('speed').append(el('option', { value: speed }, speed + '×'));
  $('speed').addEventListener('change', () => { player.speed = Number($('speed').value); });
  $('slider').addEventListener('input', () => player.seek(Number($('slider').value)));
  $('play').addEventListener('click', () => player.toggle());
  $('back').addEventListener('click', () => player.step(-1));
  $('forward').addEventListener('click', () => player.step(1));
  const all = {
    ' ': () => player.toggle(),
    ArrowRight: (event) => player.step(event.shiftKey ? 10 : 1),
    ArrowLeft: (event) => player.step(event.shiftKey ? -10 : -1),
    ArrowUp: () => player.faster(1),
    ArrowDown: () => player.faster(-1),
    Home: () => player.step(-player.rows),
    End: () => player.step(player.rows),
    d: toggleTheme,
    '?': () => $('helpbox').showModal(),
    ...keys,
  };
  document.addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || $('helpbox').open) return;
    if (event.target instanceof HTMLSelectElement) return;
    const action = all[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();  // also: the focused button must not be pressed by space as well
    action(event);
  });
}

function showPlayer(player) {
  const button = $('play');
  button.dataset.playing = String(player.playing);
  button.setAttribute('aria-label', player.playing ? 'Pause' : 'Play');
  $('speed').value = String(player.speed);
}
