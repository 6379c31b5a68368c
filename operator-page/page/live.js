// The live part: the stream of states, what the cell is doing in words, who has the say, and Stop.
//
// Runs in the browser's one thread: thirteen times a second when a state comes, and by timers that look whether none does. Stop waits for nothing
// else and is tried two ways; if both fail, that is said. A state that cannot be read is left out, and the next one comes soon.
'use strict';

/** Without a state for this long the server is lost, ms: ten states. With LOOKS it is said well within a second. */
const SILENT = 750;
/** How often it is looked, ms. */
const LOOKS = 100;
let last = 0, stream = null, state = null, mine = false, stopPort = 0, announced = '';
/** The ticks of the last minute, by their place in the rows of the server. */
let points = [];
const [TICK, T, ALPHA, MEASURED, AREA, DOUBT, D, POURED, SD, PHASE, EPISODE, GOAL] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11];
/** After this a way of Stop has failed, ms: the server tries for 6 s, and may begin a moment late. */
const STOP_WAITS = 8000;
const SIGNS = { ready: '✓', moving: '▶', waiting: '!', lost: '✕' };

/** How often Stop was asked for. An order under way meanwhile is followed by another Stop. */
let stops = 0;
/** Stop goes two ways at the same time: with the page's own server, and with a port where nothing else is answered. */
async function stop() {
  stops += 1;
  const begin = performance.now();
  const word = $('stop-word');
  word.textContent = 'Stopping …';
  $('stop-said').textContent = '';
  const refused = [];
  const way = async (url, options) => {
    try {
      const answer = await answered(await ask(url, { method: 'POST', signal: within(STOP_WAITS), ...options }));
      if (state && answer.stops > state.stops) state.stops = answer.stops;
      return answer;
    } catch (error) {
      // A refusal is said as soon as it comes; if the other way leads through, that takes its place.
      if (!(error instanceof TypeError || error instanceof DOMException)) {
        refused.push(error.message);
        $('stop-said').textContent = `Stop failed: ${error.message}. Use the robot's own stop.`;
      }
      throw error;
    }
  };
  const ways = [way('/api/stop', { headers: { 'Content-Type': 'application/json' }, body: '{}' })];
  if (stopPort) ways.push(way(`http://${location.hostname}:${stopPort}/stop`, { headers: { 'Content-Type': 'text/plain' }, body: '' }));
  try {
    const answer = await Promise.any(ways);
    $('stop-said').textContent = `Stop: ${answer.words} (${(performance.now() - begin).toFixed(0)} ms)`;
  } catch (error) {
    const late = error.errors?.some(e => e instanceof DOMException);
    if (!refused.length) $('stop-said').textContent = late ? 'Stop: no answer in time; it is still being tried. Use the robot\'s own stop.' : 'Stop failed: the page\'s server cannot be reached. Use the robot\'s own stop.';
  }
  word.textContent = 'Stop';
  // What was said of this Stop is not taken for an answer to a later one.
  const said = $('stop-said').textContent;
  setTimeout(() => { if ($('stop-said').textContent === said) $('stop-said').textContent = ''; }, 8000);
}
// It stops as the button goes down, and not when it comes up again; a click that no pointer made, as a key's or a screen reader's, stops too.
// A pointer that slides off makes no click, so what it pressed is forgotten when it comes up. A Stop too many does no harm.
let pressed = false;
$('stop').onpointerdown = event => { if (event.button === 0) { pressed = true; stop(); } };
$('stop').onclick = event => { if (event.detail === 0 || !pressed) stop(); pressed = false; };
for (const kind of ['pointerup', 'pointercancel']) addEventListener(kind, () => setTimeout(() => { pressed = false; }), true);

/** Orders a motion, with what this page has seen last: if somebody has stopped since, or it comes late, the server refuses it. If Stop was asked for
 *  while the order was under way, it is asked for again after it. */
async function postMotion(path, order = {}) {
  const before = stops;
  try {
    return await post(path, { ...order, stops: state?.stops, sent_at_ms: state?.sent_at_ms });
  } finally {
    if (stops !== before) stop();
  }
}

// The space bar stops, wherever the focus is: it never presses another button. In a field for words it is a space.
function takesSpace(target) { return target.matches?.('input[type="text"], textarea'); }
for (const kind of ['keydown', 'keyup']) {
  addEventListener(kind, event => {
    if (event.code !== 'Space' || takesSpace(event.target)) return;
    event.preventDefault();
    event.stopPropagation();
    if (kind === 'keydown' && !event.repeat) stop();
  }, true);
}

/** Says that the server is lost, until a state comes. */
function lose() {
  document.body.classList.add('lost');
  $('lost').hidden = false;
}

/** What the connection has said last; empty while all is well. */
let trouble = '';
/** Says once what is wrong with the connection, and takes it back when all is well; another line that stands there by then stays. */
function sayOfConnection(line) {
  if (line === trouble) return;
  if (line || $('said').textContent === trouble) say(line);
  trouble = line;
}

/** When the newest connection was begun. */
let connected = 0;
/** Takes states as long as they come. The browser's own way to a stream of events (EventSource) sends no token. */
async function connect() {
  connected = performance.now();
  stream?.abort();
  const begun = stream = new AbortController();
  try {
    const response = await ask('/events', { signal: begun.signal });
    if (!response.ok) await answered(response);
    sayOfConnection('');
    const reader = response.body.getReader(), decoder = new TextDecoder();
    let text = '';
    for (let part = await reader.read(); !part.done; part = await reader.read()) {
      const events = (text + decoder.decode(part.value, { stream: true })).split('\n\n');
      text = events.pop();
      // Each by itself, so that one which the page cannot show ends nothing.
      events.forEach(event => queueMicrotask(() => take(event.slice('data: '.length))));
    }
  } catch (error) {
    if (begun === stream && !(error instanceof TypeError || error instanceof DOMException)) sayOfConnection(error.message);
  }
  // A server that has ended closes its connections, which is noticed at once.
  if (begun === stream) { stream = null; lose(); }
}

/** Takes a state as the server sends it. */
function take(text) {
  last = performance.now();
  document.body.classList.remove('lost');
  $('lost').hidden = true;
  let next;
  try { next = JSON.parse(text); } catch { return; }
  state = next;
  const newest = points.length ? points[points.length - 1][TICK] : -1;
  const fresh = state.live.points;
  if (fresh.length && fresh[fresh.length - 1][TICK] < newest) points = [];
  points.push(...fresh.filter(p => !points.length || p[TICK] > points[points.length - 1][TICK]));
  if (points.length > 1800) points.splice(0, points.length - 1800);
  headline();
  listeners.forEach(listener => listener(state));
}

function headline() {
  document.body.dataset.kind = state.kind;
  $('sign').textContent = SIGNS[state.kind] || '?';
  $('words').textContent = state.doing;
  const warning = state.live.status?.robot_warning;
  $('remedy').textContent = state.remedy || (warning ? `Warning: ${warning}.` : '');
  $('who').textContent = mine ? 'you have the say' : state.say ? `${state.say} has the say` : 'nobody has the say';
  $('take').textContent = mine ? 'Give the say back' : state.say ? 'Take it over' : 'Take the say';
  // A screen reader hears what changes, and not every tenth of a millilitre.
  const brief = state.kind === 'moving' ? state.doing.split(':')[0] : `${state.doing}. ${state.remedy}`;
  if (brief !== announced) { announced = brief; $('announce').textContent = brief; }
  document.title = `${state.doing} · Decant`;
}

$('take').onclick = () => attempt(async () => { 
  const answer = await post(mine ? '/api/leave' : '/api/say');
  mine = answer.mine;
  // Taking the say stops what another page has ordered, and what this page orders from now on is meant.
  if (state && answer.stops > state.stops) state.stops = answer.stops;
});

// A server that is gone is noticed within a second.
setInterval(() => {
  if (performance.now() - last >= SILENT) lose();
}, LOOKS);
// A connection whose other end is gone without a word stays open for the browser; so what counts is when something came.
setInterval(() => { if (!stream || performance.now() - Math.max(last, connected) > 3000) connect(); }, 1500);

/** Whether this page holds a pour. */
let holding = false;
async function here() {
  try { mine = (await post('/api/here', { holding })).mine; } catch { mine = false; }
}
setInterval(() => { if (mine && !holding) here(); }, 1500);
// The connection of Stop's own way is kept open, and the browser knows that it may send the token there, so that a Stop waits for neither.
setInterval(() => {
  if (stopPort && !document.hidden) alive();
}, 3000);
/** After this Stop's own way is not there, ms. Chosen by hand: it answers at once. */
const ALIVE_WAITS = 2500;
async function alive() {
  let there = false;
  try {
    there = (await ask(`http://${location.hostname}:${stopPort}/stop`, { signal: within(ALIVE_WAITS) })).ok;
  } catch { /* It is said below. */ }
  $('stop-way').hidden = there;
  $('stop-way').textContent = there ? '' : `Stop's own port (${stopPort}) cannot be reached: Stop has one way less.`;
}

async function begin() {
  await taken;
  try {
    about = await get('/api/about');
    points = await get('/api/minute');
  } catch (error) {
    sayOfConnection(reason(error));
    setTimeout(begin, 1500);
    return;
  }
  sayOfConnection('');
  stopPort = about.stop_port;
  $('cell').textContent = about.cell;
  $('about').textContent = `Decant ${about.version} · ${about.config}`;
  dispatchEvent(new CustomEvent('known'));
  alive();
  connect();
  // A page that is loaded again may have the say still.
  here();
}
addEventListener('load', begin);
