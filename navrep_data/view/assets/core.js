// Data, elements, theme: what both pages share.
const $ = (id) => document.getElementById(id);
const meta = JSON.parse($('meta').textContent);
const NAN_CODE = 65535;

// An element with attributes and children; strings become text nodes, never markup.
function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === 'colour') node.style.background = value;
    else if (name === 'onclick') node.addEventListener('click', value);
    else node.setAttribute(name, value);
  }
  node.append(...children);
  return node;
}

function fatal(error) {
  $('fatal').textContent = error && error.message ? error.message : String(error);
  $('fatal').hidden = false;
}

const DAMAGED = 'The data of this page are damaged. Make the page again with navrep-data view.';

async function inflate(bytes, size) {
  if (typeof DecompressionStream === 'function') {
    let stream = null;
    try {
      stream = new DecompressionStream('deflate-raw');
    } catch { /* older browsers know gzip only */ }
    if (stream) {
      const result = await new Response(new Blob([bytes]).stream().pipeThrough(stream)).arrayBuffer();
      return new Uint8Array(result);
    }
  }
  return inflateRaw(bytes, size);
}

// One array of a stream: `codes` as stored, `at(i)` the number at flat index i (NaN where unknown).
class Packed {
  constructor({ type, shape, at, origin, step }, bytes) {
    this.shape = shape;
    this.origin = origin;
    this.step = step;
    const count = shape.reduce((a, b) => a * b, 1);
    this.codes = type === 'u8' ? bytes.subarray(at, at + count) : Packed.unfold(bytes, at, count, shape[shape.length - 1]);
  }

  // Zigzag differences along the last axis, all low bytes before all high bytes.
  static unfold(bytes, at, count, width) {
    const codes = new Uint16Array(count);
    for (let i = 0; i < count; i++) {
      const folded = bytes[at + i] | (bytes[at + count + i] << 8);
      codes[i] = (i % width ? codes[i - 1] : 0) + ((folded >> 1) ^ -(folded & 1));
    }
    return codes;
  }

  at(i) {
    const code = this.codes[i];
    return code === NAN_CODE ? NaN : this.origin + this.step * code;
  }

  // Numbers [from, to) of line `line` of a two-dimensional array.
  value(line, i) {
    return this.at(line * this.shape[this.shape.length - 1] + i);
  }
}

const unpacked = new Map();
async function unpack(entry) {
  if (!unpacked.has(entry.blob)) {
    const text = atob($('blob-' + entry.blob).textContent.trim());
    const packed = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
    const bytes = await inflate(packed, entry.size).catch(() => { throw new Error(DAMAGED); });
    if (bytes.length !== entry.size) throw new Error(DAMAGED);
    const arrays = {};
    for (const [name, array] of Object.entries(entry.arrays)) arrays[name] = new Packed(array, bytes);
    unpacked.set(entry.blob, arrays);
  }
  return unpacked.get(entry.blob);
}

// Colours by name, read again whenever the theme changes.
const palette = {};
function readPalette() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ['bg', 'panel', 'ink', 'muted', 'line', 'accent', 'obstacle', 'obstacle-edge', 'robot', 'human', 'leg',
    'ray', 'goal', 'ring-free', 'ring-unknown', 'ring-occupied', 'a', 'b', 'c']) palette[name] = style.getPropertyValue('--' + name).trim();
  for (const name of OUTCOMES) palette['o-' + name] = style.getPropertyValue('--o-' + name).trim();
}
const OUTCOMES = ['goal', 'collision_human', 'collision_obstacle', 'timeout', 'stuck', 'cut', 'none'];
const OUTCOME_TEXT = {
  goal: 'goal', collision_human: 'hit a human', collision_obstacle: 'hit an obstacle', timeout: 'timeout', stuck: 'stuck',
  cut: 'cut off', none: 'open end',
};
const OUTCOME_LETTER = { goal: 'G', collision_human: 'H', collision_obstacle: 'O', timeout: 'T', stuck: 'S', cut: '·', none: '·' };
const known = (event) => (OUTCOMES.includes(event) ? event : 'none');
const outcomeColour = (event) => palette['o-' + known(event)];

function setTheme(name) {
  document.documentElement.dataset.theme = name;
  $('theme').setAttribute('aria-label', name === 'dark' ? 'Light colours' : 'Dark colours');
  readPalette();
  window.dispatchEvent(new Event('themechange'));
}
function toggleTheme() {
  setTheme(document.documentElement.dataset.theme === 'dark' ? 'light' : 'dark');
}
function startTheme() {
  const dark = window.matchMedia('(prefers-color-scheme: dark)');
  setTheme(dark.matches ? 'dark' : 'light');
  dark.addEventListener('change', (event) => setTheme(event.matches ? 'dark' : 'light'));
  $('theme').addEventListener('click', toggleTheme);
}

function startHelp() {
  const box = $('helpbox');
  for (const [name, value] of meta.facts) $('facts').append(el('dt', {}, name), el('dd', {}, value));
  for (const note of meta.notes) $('notes').append(el('li', {}, note));
  $('notes-part').hidden = meta.notes.length === 0;
  $('help').addEventListener('click', () => box.showModal());
  $('help-close').addEventListener('click', () => box.close());
  box.addEventListener('click', (event) => { if (event.target === box) box.close(); });
  document.title = meta.title + ' – navrep-data view';
  $('title').textContent = meta.title;
  $('title').title = meta.title;
  const left = meta.notes.length ? ' · not all is in this page, see ?' : '';
  $('subtitle').textContent = meta.facts.slice(0, 2).map(([, value]) => value).join(' · ') + left;
}

const key = (colour, text) => el('span', { class: 'key' }, el('span', { class: 'swatch', colour }), text);
const fixed = (value, digits) => (Number.isFinite(value) ? value.toFixed(digits).replace('-', '−') : '?');
