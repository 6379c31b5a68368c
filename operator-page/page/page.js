// What all parts of the page use: finding and making elements, asking the server, and saying what went wrong. Everything that comes from the
// server is put into the page as text, never as markup.
//
// All scripts of the page run in the browser's one thread and share their names; index.html loads this one first. Nothing here waits but for
// the server. What fails is one line above the content (`attempt`); without a server the page greys out (live.js).
'use strict';

const $ = id => document.getElementById(id);

/** Makes an element. `properties` are set as they are; children are elements or text. */
function el(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith('aria-') || name === 'role' || name === 'scope') made.setAttribute(name, value);
    else made[name] = value;
  }
  made.append(...children.filter(c => c !== null && c !== undefined).map(c => (c instanceof Node ? c : String(c))));
  return made;
}

/** Puts `children` in the place of what is in `parent`. */
function fill(parent, ...children) { parent.replaceChildren(...children.filter(c => c !== null && c !== undefined)); }

/** The token as this page knows it. It is here, and not looked up when it is needed: a Stop waits for no storage. */
let token = '';

/** What this browser keeps of the page under a name; empty if it keeps nothing, as where its user has forbidden that. */
function kept(name, storage = 'localStorage') {
  try { return window[storage].getItem(name) || ''; } catch { return ''; }
}
/** Keeps a value; an empty one is forgotten. Where nothing may be kept, it lasts as long as the page. */
function keep(name, value, storage = 'localStorage') {
  try {
    if (value) window[storage].setItem(name, value); else window[storage].removeItem(name);
  } catch { /* The page works without. */ }
}

/** This page's own name for itself, by which the server knows who has the say. It lies in the session's storage only while the page is loaded
 *  anew: a tab that is duplicated gets a copy of the storage, and must not get the say with it. */
const own = { id: kept('decant-id', 'sessionStorage'), name: kept('decant-name') };
if (!own.id) own.id = [...crypto.getRandomValues(new Uint8Array(16))].map(b => b.toString(16).padStart(2, '0')).join('');
addEventListener('pagehide', () => keep('decant-id', own.id, 'sessionStorage'));
addEventListener('pageshow', () => keep('decant-id', '', 'sessionStorage'));

/** Where this browser keeps the token: in a storage of this port's pages. A cookie would go to every port of the host, whoever listens there. */
const TOKEN = 'decant-token';
token = kept(TOKEN);
// Another tab has taken a new one.
addEventListener('storage', event => { if (event.key === TOKEN) token = event.newValue || token; });

/** Asks the server, with the token if this browser has one. */
function ask(url, options = {}, word = token) {
  return fetch(url, word ? { ...options, headers: { ...options.headers, Authorization: `Bearer ${word}` } } : options);
}

/** Says one line above the content; an empty line takes it away. */
function say(line, good = false) {
  $('said').textContent = line;
  $('said').classList.toggle('good', good);
}

async function answered(response) {
  const answer = await response.json().catch(() => ({}));
  if (!response.ok) throw new Error(answer.error || `the server answered ${response.status}`);
  return answer;
}

/** A signal that ends a request after so many ms; older browsers have no AbortSignal.timeout. */
function within(ms) {
  if (typeof AbortController !== 'function') return undefined;
  const controller = new AbortController();
  setTimeout(() => controller.abort(), ms);
  return controller.signal;
}
/** After this an answer no longer comes, ms: the server gives up after 60 s. */
const ANSWER_WAITS = 65000;

/** Takes the token out of the address's fragment, which no browser sends. */
async function takeToken() {
  if (!location.hash.startsWith('#token=')) return;
  const given = location.hash.slice('#token='.length);
  window.history.replaceState(null, '', location.pathname);
  if (!/^[0-9A-Za-z]+$/.test(given)) return;
  // Without one there is nothing to lose, and a Stop needs it at once.
  token ||= given;
  await judge(given);
}
/** Keeps a token that the server takes. Anybody can write a link to this page, so one that it refuses takes no other's place. */
async function judge(given) {
  let answer;
  try { answer = await ask('/api/about', { signal: within(ANSWER_WAITS) }, given); } catch { setTimeout(judge, 1500, given); return; }
  if (answer.status !== 401) {
    token = given;
    keep(TOKEN, given);
  } else if (token !== given) {
    say('The server refuses the token in that address: the one from before stays in use.');
  }
}
/** The token of the address with which the page was opened, once it is judged. */
const taken = takeToken();
// Into a page that is open already, an address with a token is only a jump.
addEventListener('hashchange', takeToken);

/** Looks something up. */
async function get(path) { return answered(await ask(path, { signal: within(ANSWER_WAITS) })); }

/** Orders something. */
async function post(path, order = {}) {
  const body = JSON.stringify({ ...own, ...order });
  return answered(await ask(path, { method: 'POST', headers: { 'Content-Type': 'application/json' }, body, signal: within(ANSWER_WAITS) }));
}

/** Looks a picture up; an image that loads by itself sends no token. */
async function getPicture(path) {
  const response = await ask(path, { signal: within(ANSWER_WAITS) });
  if (!response.ok) await answered(response);
  return response;
}

/** Puts a picture in the place of the one that the image shows; without one it shows none. */
function put(image, picture) {
  if (image.src.startsWith('blob:')) URL.revokeObjectURL(image.src);
  if (picture) image.src = URL.createObjectURL(picture); else image.removeAttribute('src');
}

/** After this a file that was saved is on the browser's disk, ms. Chosen by hand: it only has to be copied there. */
const SAVED = 60000;
/** Saves a file of the server on the browser's disk, as a link would, which sends no token. However long it is under way, it is waited for. */
async function save(path, name) {
  say(`${name} is on its way …`, true);
  const response = await ask(path);
  if (!response.ok) await answered(response);
  const href = URL.createObjectURL(await response.blob());
  el('a', { href, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(href), SAVED);
  say('');
}

/** Why a request failed, in words. */
function reason(error) {
  if (error instanceof DOMException) return 'The page\'s server gave no answer in time.';
  return error instanceof TypeError ? 'The page\'s server cannot be reached.' : error.message;
}

/** Does something that may fail, and says so in one line. Gives undefined then. */
async function attempt(what) {
  try {
    say('');
    return await what();
  } catch (error) {
    say(reason(error));
    return undefined;
  }
}

/** A plain decimal as people type it, with a comma or a point; NaN for anything else. 1,250 and 1.250 are a thousand to some and one to others, so
 *  they are no number. */
function decimal(text) {
  const plain = /^[+-]?(\d+([.,]\d*)?|[.,]\d+)$/.test(text), grouped = /^[+-]?[1-9]\d{0,2}[.,]\d{3}$/.test(text);
  return plain && !grouped ? Number(text.replace(',', '.')) : NaN;
}
/** A number as people type it; undefined for an empty field, NaN for what is no number. */
function typed(id) {
  const text = $(id).value.trim();
  return text === '' ? undefined : decimal(text);
}
/** What is added where a number is refused. */
const PLAIN = 'A comma or point before exactly three digits is not understood: leave it out, or give other decimals.';

/** A number as people read it; zero has no sign. */
const shown = (value, digits = 1) => (Number.isFinite(value) ? value.toFixed(digits).replace(/^-(0(\.0*)?)$/, '$1') : '–');

/** A goal with the decimals that it was given. */
const goalWords = ml => (Number.isFinite(ml) ? String(Number(ml.toPrecision(6))) : '–');

/** So many of something, in words. */
const many = (n, one) => `${n} ${one}${n === 1 ? '' : 's'}`;

/** The time since something, in words. */
function ago(seconds) {
  if (!Number.isFinite(seconds)) return 'of unknown age';
  for (const [unit, name] of [[86400, 'day'], [3600, 'hour'], [60, 'minute']]) {
    const n = Math.floor(seconds / unit);
    if (n >= 1) return `${n} ${name}${n > 1 ? 's' : ''} old`;
  }
  return 'less than a minute old';
}

/** What the parts of the page do with each new state. */
const listeners = [];
/** What does not change while the server runs; null until it is known. */
let about = null;

// Tabs: a click, or the arrow keys.
const tabs = [...document.querySelectorAll('[role="tab"]')];
function choose(tab, focus = false) {
  for (const other of tabs) {
    const chosen = other === tab;
    other.setAttribute('aria-selected', chosen);
    other.tabIndex = chosen ? 0 : -1;
    $(other.getAttribute('aria-controls')).hidden = !chosen;
  }
  if (focus) tab.focus();
  say('');
  dispatchEvent(new CustomEvent('tab', { detail: tab.getAttribute('aria-controls') }));
}
tabs.forEach((tab, k) => {
  tab.onclick = () => choose(tab);
  tab.onkeydown = event => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (step) { event.preventDefault(); choose(tabs[(k + step + tabs.length) % tabs.length], true); }
  };
});

$('name').value = own.name;
$('name').onchange = () => { own.name = $('name').value.trim(); keep('decant-name', own.name); };
$('theme').value = kept('decant-theme');
function theme() {
  if ($('theme').value) document.documentElement.dataset.theme = $('theme').value;
  else delete document.documentElement.dataset.theme;
  keep('decant-theme', $('theme').value);
}
$('theme').onchange = theme;
theme();
