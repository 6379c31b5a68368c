// The first tab: camera, plots, a pour from goal to weight, the weights in use, and the loop's lateness.
//
// Runs in the browser's one thread with each new state; pictures are asked for by a timer, one at a time. A picture that does not come is said
// over the last one, and an order that is refused above the content.
'use strict';

const SHOWN_S = 30;
let frame = null, hold = false, ordered = 0;

/** Draws the camera's picture with region, axes, line and triangle: each with its own dash, and named below. */
const LINES = [
  ['region', '#ffffff', [3, 4], 'region that is looked at'], ['x', '#ff5a5a', [9, 4], 'x-axis: the glass\'s top edge'],
  ['y', '#4be04b', [4, 3], 'y-axis: the left side'], ['edge', '#ffff00', [], 'line of the stream and triangle (V_e)'],
];

function overlay(p, size, scale, measured) {
  const draw = (k, width, points, closed) => {
    p.strokeStyle = '#000a'; p.lineWidth = width + 2; p.setLineDash([]);
    for (let pass = 0; pass < 2; pass += 1) {
      p.beginPath();
      points.forEach(([x, y]) => p.lineTo(x * scale, y * scale));
      if (closed) p.closePath();
      p.stroke();
      p.strokeStyle = LINES[k][1]; p.lineWidth = width; p.setLineDash(LINES[k][2]);
    }
    p.setLineDash([]);
  };
  const [x, y, w, h] = about.region_px;
  draw(0, 2, [[x, y], [x + w, y], [x + w, y + h], [x, y + h]], true);
  const [ax, ay, bx, by] = about.x_axis_px, [cx, cy, dx, dy] = about.y_axis_px;
  draw(1, 2.5, [[ax, ay], [bx, by]]);
  draw(2, 2.5, [[cx, cy], [dx, dy]]);
  if (measured && measured.area_px2 > 0) {
    const t = measured.triangle_px;
    draw(3, 1.5, [[t[0], t[1]], [t[2], t[3]], [t[4], t[5]]], true);
    draw(3, 3, [[t[2], t[3]], [t[4], t[5]]]);
  }
}

async function picture() {
  const begin = performance.now();
  if (about && state && !document.hidden && !$('pour').hidden && !document.body.classList.contains('lost')) {
    try {
      const response = await ask('/picture.jpg');
      if (!response.ok) await answered(response);
      const found = JSON.parse(response.headers.get('x-frame'));
      if (!frame || frame.sequence !== found.sequence) {
        const bitmap = await createImageBitmap(await response.blob());
        const canvas = $('camera');
        if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) { canvas.width = bitmap.width; canvas.height = bitmap.height; }
        const p = canvas.getContext('2d');
        p.drawImage(bitmap, 0, 0);
        overlay(p, found.size_px, bitmap.width / found.size_px[0], found.measured);
        frame = found;
        const m = found.measured;
        const words = m ? `Frame ${found.sequence}: V_e ${shown(m.area_px2, 0)} px², confidence ${shown(m.confidence, 2)}, ${m.doubt === 'none' ? 'no doubt' : `DOUBT: ${m.doubt}`}.`
          : `Frame ${found.sequence}: not measured (does the feature worker run?).`;
        $('frame-words').textContent = words;
        $('frame-words').className = m && m.doubt === 'none' ? '' : 'warn';
        canvas.dataset.frames = Number(canvas.dataset.frames || 0) + 1;
        canvas.setAttribute('aria-label', `Camera picture. ${words}`);
      }
    } catch (error) {
      dark(error instanceof TypeError ? 'the page\'s server cannot be reached' : error.message);
    }
  }
  setTimeout(picture, Math.max(5, 75 - (performance.now() - begin)));
}

/** Says that there is no picture, over the last one. */
function dark(why) {
  const canvas = $('camera'), p = canvas.getContext('2d');
  $('frame-words').textContent = `No picture: ${why}`;
  $('frame-words').className = 'bad';
  canvas.setAttribute('aria-label', `No camera picture: ${why}`);
  p.fillStyle = '#000c'; p.fillRect(0, 0, canvas.width, canvas.height);
  p.fillStyle = '#fff'; p.font = '22px system-ui, sans-serif'; p.textAlign = 'center'; p.fillText('no picture', canvas.width / 2, canvas.height / 2);
  frame = null;
}

function plots() {
  if ($('pour').hidden || !points.length) return;
  const to = points[points.length - 1][T], from = to - SHOWN_S;
  const seen = points.filter(p => p[T] >= from - 1);
  const of = (column, sd) => seen.map(p => [p[T] - to, p[column], sd ? p[sd] : 0]);
  // A curve has no goal, and nobody counts what it pours.
  const counted = seen.filter(p => Number.isFinite(p[GOAL])), last = counted[counted.length - 1];
  const during = column => seen.map(p => [p[T] - to, Number.isFinite(p[GOAL]) ? p[column] : NaN]);
  const marks = seen.filter(p => p[DOUBT] > 0).map(p => ({ t: p[T] - to }));
  const list = [
    { title: 'Tilt alpha', unit: 'degrees', low: 0, high: 20, series: [
      { name: 'commanded', colour: '--series-1', points: of(ALPHA) }, { name: 'measured', colour: '--series-2', dash: 1, points: of(MEASURED) }] },
    { title: 'Stream V_e', unit: 'px²', low: 0, high: 100, marks, series: [{ name: 'V_e', colour: '--series-3', bridge: true, points: of(AREA) }] },
    { title: 'Volume', unit: 'ml', low: 0, high: 20, series: [
      { name: 'poured (±1 deviation)', colour: '--series-1', points: during(POURED).map(([t, v], k) => [t, v, seen[k][SD]]) },
      { name: 'still to pour, d', colour: '--series-4', dash: 2, points: during(D) }] },
  ];
  panels($('plots'), { from: -SHOWN_S, to: 0, list });
  const newest = points[points.length - 1];
  const doubts = [...new Set(seen.filter(p => p[DOUBT] > 0).map(p => about.doubts[p[DOUBT]]))];
  $('plots-words').textContent = `Now: alpha ${shown(newest[ALPHA])}° commanded, ${shown(newest[MEASURED])}° measured` +
    (last ? `; ${shown(last[POURED])}${last[SD] > 0 ? ` ± ${shown(last[SD])}` : ''} ml poured${last[SD] > 0 ? '' : ' (how far off that is, is not known)'}` : '') + (doubts.length ? `. Doubts in view: ${doubts.join(', ')}.` : '.');
}

// A pour: goal, what is foreseen, confirm.
let foreseen = null;
$('pour-form').onsubmit = event => {
  event.preventDefault();
  attempt(async () => {
    const goal = typed('goal'), inside = typed('fill');
    if (!Number.isFinite(goal)) throw new Error(`Type the goal in ml, for example 75. ${PLAIN}`);
    if (Number.isNaN(inside)) throw new Error(`Type what is in the vessel in ml, or leave it empty. ${PLAIN}`);
    foreseen = { goal_ml: goal, fill_ml: inside ?? null, ...(await post('/api/foresee', { goal_ml: goal, fill_ml: inside ?? null })) };
    if (!foreseen.possible) { $('confirm').hidden = true; throw new Error(foreseen.lines.join(' ')); }
    const sd = foreseen.sd_ml;
    fill($('foreseen'), el('span', { className: 'big' }, `Pour ${goalWords(goal)} ml`),
      el('br'), sd ? `Expected to end within ±${shown(sd)} ml (one standard deviation).` : 'It is not known how far off it will be.',
      foreseen.flows_by_deg ? ` It must flow by ${shown(foreseen.flows_by_deg, 0)}° of tilt.` : null,
      ...foreseen.lines.map(line => el('p', { className: 'warn' }, `! ${line}`)));
    $('go').textContent = hold ? `Hold to pour ${goalWords(goal)} ml` : `Pour ${goalWords(goal)} ml now`;
    $('confirm').hidden = false;
    $('go').focus();
  });
};
$('back-out').onclick = () => { $('confirm').hidden = true; $('goal').focus(); };
$('hold').onclick = () => {
  hold = !hold;
  $('hold').setAttribute('aria-pressed', hold);
  $('hold').textContent = hold ? 'Hold to pour: on. It stops when you let go, or when this page is lost' : 'Hold to pour: off';
  $('confirm').hidden = true;
};

async function order() {
  $('stop-said').textContent = '';
  $('result').hidden = true;
  const answer = await attempt(() => postMotion('/api/pour', { goal_ml: foreseen.goal_ml, fill_ml: foreseen.fill_ml, identity: foreseen.identity, lines: foreseen.lines, hold }));
  if (answer) { ordered = answer.episode; mine = true; if (!hold) $('confirm').hidden = true; } else if (holding) letGo(false);
}
$('go').onclick = () => { if (!hold) order(); };
let beat = 0;
function press() {
  if (!hold || holding) return;
  holding = true;
  order();
  beat = setInterval(here, 200);
}
function letGo(stops = true) {
  if (!holding) return;
  holding = false;
  clearInterval(beat);
  $('confirm').hidden = true;
  if (stops) stop();
}
$('go').onpointerdown = event => { if (hold) { $('go').setPointerCapture(event.pointerId); press(); } };
// Letting go stops also an order that has not begun yet.
for (const kind of ['pointerup', 'pointercancel', 'blur', 'lostpointercapture']) $('go').addEventListener(kind, () => letGo());
// An Enter that is still held down from the goal's field confirms nothing.
$('go').addEventListener('keydown', event => {
  if (event.key !== 'Enter') return;
  if (hold || event.repeat) event.preventDefault();
  if (hold && !event.repeat) press();
});
$('go').addEventListener('keyup', event => { if (event.key === 'Enter') letGo(); });
$('resume').onclick = () => attempt(async () => { await postMotion('/api/resume'); say('The robot is connected.', true); });

/** A weight that is further from the estimate than this share of it is asked for twice. Chosen by hand: a slipped digit is further off. */
const FAR = 0.5;
/** Asks for the scale's reading of an episode. `done` gets it. A weight that is there already, or is far from the volume `estimate`, is asked for twice. */
function scale(file, goal, done, estimate = NaN) {
  const input = el('input', { inputMode: 'decimal', autocomplete: 'off', className: 'grams' });
  const said = el('p', { role: 'status' });
  const form = el('form', { noValidate: true }, el('label', {}, 'The scale says, g ', input),
    el('p', { className: 'row' }, el('button', { type: 'submit', className: 'primary' }, 'Enter the weight'),
      el('button', { type: 'button', className: 'skip-weight', onclick: () => done(null) }, 'Skip')), said);
  let replaced = null, asked = NaN;
  form.onsubmit = event => {
    event.preventDefault();
    const grams = decimal(input.value.trim());
    if (!Number.isFinite(grams)) { said.textContent = `Type the scale's reading in g, for example 74. ${PLAIN}`; return; }
    if (Math.abs(grams - estimate) > FAR * Math.abs(estimate) && asked !== grams) {
      asked = grams;
      said.textContent = `By the estimate it is ${shown(estimate)} ml: if the scale really says ${grams} g, enter it again.`;
      return;
    }
    attempt(async () => {
      try {
        await post('/api/weigh', { file, grams, shown_g: replaced });
      } catch (error) {
        // If it has a weight already, the refusal says which; entered again, that one is replaced.
        await reload();
        replaced = table.episodes.find(e => e.file === file)?.weight_g ?? null;
        said.textContent = error instanceof TypeError || error instanceof DOMException ? '' : error.message;
        throw error;
      }
      done(grams, Number.isFinite(goal) ? grams - goal : null);
    });
  };
  return form;
}

/** How far a pour is off its goal by the estimate. Where liquid may have left unseen, what is missing is less, or nothing. */
function offGoal({ poured_ml: poured, poured_sd_ml: sd, goal_ml: goal, unseen }) {
  const off = shown(Math.abs(poured - goal)), doubt = sd > 0 ? ` ± ${shown(sd)}` : '';
  if (!unseen) return `By the estimate it is ${off}${doubt} ml ${poured < goal ? 'short of' : 'over'} the goal.`;
  return poured < goal ? `More may have left than was seen: at most ${off}${doubt} ml are missing. Weigh it before anything is added.`
    : `It is at least ${off}${doubt} ml over the goal.`;
}

let resultOf = 0;
/** The result of the newest pour or recording, once. */
function result() {
  const outcomes = state.live.status?.outcomes || [];
  const newest = outcomes[outcomes.length - 1];
  if (!newest || newest.episode !== ordered || resultOf === newest.episode) return;
  if (!newest.file && !newest.no_file && performance.now() - (result.since ||= performance.now()) < 10000) return;
  result.since = 0;
  resultOf = newest.episode;
  if (holding) letGo(false);
  const goal = newest.goal_ml, curve = goal === null;
  const head = curve ? `Curve recorded in ${shown(newest.seconds)} s` : `${newest.poured} ml poured of ${goalWords(goal)} ml`;
  const body = [el('p', { className: 'big' }, head),
    newest.unsure ? el('p', { className: 'warn' }, `! After ${shown(newest.seconds)} s it is ${newest.reason}.`)
      : el('p', { className: newest.done ? 'good' : 'bad' }, newest.done ? `✓ Done after ${shown(newest.seconds)} s.` : `✕ It ended early: ${newest.reason}.`)];
  if (!curve) body.push(el('p', {}, offGoal(newest)));
  const after = el('div');
  if (newest.file) {
    after.append(scale(newest.file, goal, (grams, error) => {
      fill(after, grams === null ? el('p', { className: 'hint' }, `Not weighed. It can be weighed later, under Record and learn (${newest.file}).`)
        : el('p', { className: 'big' }, error === null ? `Weighed: ${shown(grams)} g.` : `Weighed: ${shown(grams)} g, an error of ${error > 0 ? '+' : ''}${shown(error)} ml.`));
    }, curve ? NaN : newest.poured_ml));
  } else {
    after.append(el('p', { className: 'warn' }, `! It was not recorded: ${newest.no_file || 'no recorder answered; does feature-worker run?'}`));
  }
  fill($('result-body'), ...body, after);
  $('result').hidden = false;
}

/** Weights as people compare them. */
function weightsWords(weights, none) {
  if (!weights) return el('p', {}, none);
  if (weights.error) return el('p', { className: 'bad' }, `✕ ${weights.error}`);
  const rows = weights.expected.map(e => el('tr', {}, el('td', { className: 'number' }, `${shown(e.goal_ml, 0)} ml`),
    el('td', { className: 'number' }, Number.isFinite(e.sd_ml) ? `±${shown(e.sd_ml)} ml` : 'not known')));
  return el('div', {}, el('p', {}, `${weights.identity}, ${ago(weights.age_s)}, trained from ${many(weights.episodes, 'episode')} (${weights.method}${weights.fused ? ', fused' : ''}).`),
    el('table', {}, el('thead', {}, el('tr', {}, el('th', { className: 'number', scope: 'col' }, 'Goal'), el('th', { className: 'number', scope: 'col' }, 'Expected error'))), el('tbody', {}, ...rows)));
}

let slowShown = '';
function slow() {
  const status = state.live.status;
  $('resume').hidden = !state.may_resume;
  $('go').disabled = state.kind === 'moving' && !holding;
  const late = status?.lateness;
  const key = JSON.stringify([status?.ticks, state.weights, status?.outcomes, status?.weights_refused]);
  if (key === slowShown) return;
  slowShown = key;
  for (const place of document.querySelectorAll('.weights-now')) {
    fill(place, weightsWords(state.weights?.now, 'There is no weight file yet: record and learn first.'),
      status?.weights_refused ? el('p', { className: 'bad' }, `✕ Refused: ${status.weights_refused}`) : null,
      status && state.weights?.now?.identity && status.weights !== state.weights.now.identity ? el('p', { className: 'warn' }, '! The controller has not taken this file yet.') : null);
  }
  if (late && !$('pour').hidden) {
    histogram($('lateness'), late.bins, 'µs late, counts on a log axis');
    $('late-words').textContent = `Half of ${late.n} ticks were less than ${shown(late.p50_us, 0)} µs late, 99 % less than ${shown(late.p99_us, 0)} µs; the latest ${shown(late.max_us, 0)} µs. ${status.late_ticks} were late by half a period, ${status.skipped_ticks} were skipped.`;
  }
  const rows = (status?.outcomes || []).slice().reverse().map(o => el('tr', {}, el('td', { className: 'number' }, o.episode),
    el('td', {}, o.goal_ml === null ? 'curve' : `pour of ${goalWords(o.goal_ml)} ml`), el('td', { className: 'number' }, o.goal_ml === null ? '' : `${o.poured} ml`),
    el('td', { className: 'number' }, `${shown(o.seconds)} s`), el('td', { className: 'words' }, `${o.unsure ? '!' : o.done ? '✓' : '✕'} ${o.reason}`)));
  fill($('outcomes'), rows.length ? el('table', {}, el('thead', {}, el('tr', {}, ...[['Number', 1], ['What'], ['Poured', 1], ['Time', 1], ['How it ended']].map(([h, number]) => el('th', { scope: 'col', className: number ? 'number' : '' }, h)))), el('tbody', {}, ...rows))
    : el('p', { className: 'hint' }, status ? 'Nothing has been poured since the controller started.' : 'The controller does not answer, so its results are not known.'));
}

addEventListener('known', () => {
  $('goal-max').textContent = about.goal_max_ml;
  fill($('camera-keys'), ...LINES.map(([, colour, dash, words]) => {
    const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg'), stroke = document.createElementNS(svg.namespaceURI, 'line');
    for (const [name, value] of [['x1', 0], ['x2', 34], ['y1', 6], ['y2', 6], ['stroke', colour], ['stroke-width', 3], ['stroke-dasharray', dash.join(' ') || 'none']]) stroke.setAttribute(name, value);
    svg.setAttribute('aria-hidden', 'true');
    svg.setAttribute('viewBox', '0 0 34 12');
    svg.append(stroke);
    return el('li', {}, svg, ` ${words}`);
  }));
});
listeners.push(plots, result, slow);
addEventListener('tab', () => { slowShown = ''; });
picture();
