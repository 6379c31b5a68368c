// The second tab: record what teaches most, weigh it, learn, and choose the weights.
//
// Runs in the browser's one thread with each new state; work in the background is done by the server and only shown here. What is refused or
// fails is said where it was asked for.
'use strict';

let plannedFrom = null, planned = '', tableShown = '', jobShown = '', compareShown = '', table = { episodes: [], fault: 'the table of episodes has not come yet' };
/** What a person has said of doubtful episodes: file to true (use it) or false (leave it out). */
const judged = new Map();

/** A proposal as a person does it. */
function proposal(candidate, first) {
  const next = candidate.next;
  const head = next.kind === 'curve' ? `Fill in ${shown(next.fill_ml, 0)} ml and record a curve` : `Fill in ${shown(next.fill_ml, 0)} ml and pour ${goalWords(next.goal_ml)} ml`;
  const button = el('button', { type: 'button', className: first ? 'primary record' : 'record' }, next.kind === 'curve' ? 'It is filled: record the curve' : 'It is filled: prepare this pour');
  button.onclick = () => (next.kind === 'curve' ? record(next) : prepare(next));
  return el('div', { className: 'proposal' }, el('p', {}, el('b', {}, `${first ? '' : 'Or: '}${head}`)),
    el('p', { className: 'hint' }, next.kind === 'curve' ? `Height ${shown(next.lambda_deg, 0)}°, width ${next.gamma_per_s2} 1/s². ` : '',
      `Some ${shown(candidate.weight_ml, 0)} g should be on the scale. The camera's volume is then off by ${shown(candidate.sd_after_ml)} ml.`), button);
}

async function record(next) {
  const answer = await attempt(() => postMotion('/api/record', { lambda_deg: next.lambda_deg, gamma_per_s2: next.gamma_per_s2 }));
  if (!answer) return;
  mine = true;
  ordered = answer.episode;
  choose(tabs[0]);
}

function prepare(next) {
  $('goal').value = Number(next.goal_ml.toFixed(1));
  $('fill').value = Number(next.fill_ml.toFixed(1));
  choose(tabs[0]);
  $('pour-form').requestSubmit();
}

function showPlan(result) {
  const key = JSON.stringify(result);
  if (key === planned) return;
  planned = key;
  const plan = result?.plan;
  if (!plan) { fill($('plan')); return; }
  plannedFrom = result.episodes;
  const missing = result.check?.missing || [], left = result.check?.left_out || [];
  const nothing = !plan.candidates.length ? [el('p', { className: 'bad' }, '✕ Nothing can be proposed for this vessel: say what it really holds.')] : [];
  fill($('plan'), result.episodes ? el('p', {}, `The camera's volume of the pours to come is off by ${shown(plan.sd_now_ml)} ml now.`)
    : el('p', {}, 'Nothing has been weighed yet. The height is that of a beaker: if nothing flows, take 10 degrees more.'),
  ...nothing, ...plan.candidates.map((candidate, k) => proposal(candidate, k === 0)),
  ...checked(result.check),
  missing.length ? el('p', {}, 'Still missing: ', missing.join('; '), '.') : null,
  ...left.map(([name, what]) => el('p', { className: 'warn' }, `! Left out: ${name.split('/').pop()}: ${what}`)));
}

/** A remark of `trainer check`; one that only says what is enough is no warning. */
const remark = (what, before = '') => (what.includes(': enough') ? el('p', { className: 'hint' }, before, what) : el('p', { className: 'warn' }, `! ${before}${what}`));

/** What `trainer check` says of the set: what it spans, and what is doubtful. */
function checked(check) {
  if (!check) return [];
  const s = check.spanned;
  const span = s ? [el('p', { id: 'spanned' }, `The set spans ${shown(s.weights_g[0], 0)} to ${shown(s.weights_g[1], 0)} g; the flow began at ${shown(s.onsets_deg[0], 0)}° to ${shown(s.onsets_deg[1], 0)}° and was seen up to ${shown(s.last_tilt_deg, 0)}°.`)] : [];
  return [...span, ...(check.doubts || []).map(([name, what]) => remark(what, name === 'data set' ? '' : `${name.split('/').pop()}: `))];
}

$('make-plan').onclick = () => attempt(async () => {
  const holds = typed('holds');
  if (Number.isNaN(holds)) throw new Error(`Type what the vessel holds in ml, or leave it empty. ${PLAIN}`);
  keep('decant-holds', $('holds').value);
  await post('/api/plan', { holds_ml: holds ?? null });
  mine = true;
});
$('start-learning').onclick = () => learn();
async function learn() {
  const last = typed('last');
  if (last !== undefined && !(last >= 1)) { say('Type how many episodes, or leave it empty.'); return; }
  const names = use => [...judged].filter(([, used]) => used === use).map(([name]) => name);
  await attempt(async () => {
    await post('/api/learn', { last: last === undefined ? null : Math.floor(last), accept: names(true), leave_out: names(false) });
    mine = true;
  });
}
$('cancel').onclick = () => attempt(() => post('/api/cancel'));

const JOBS = { plan: 'Planning', learn: 'Learning', export: 'Exporting' };
function showJob(job) {
  const key = JSON.stringify(job);
  if (key === jobShown) return;
  jobShown = key;
  const busy = job.number > 0 && !job.done;
  $('cancel').hidden = !busy;
  for (const id of ['start-learning', 'make-plan']) $(id).disabled = busy;
  const place = job.kind === 'export' ? $('export-said') : $('job');
  const other = job.kind === 'export' ? $('job') : $('export-said');
  fill(other);
  if (job.number === 0) { fill(place); return; }
  if (busy) {
    const bar = el('progress', { 'aria-label': `${JOBS[job.kind]}: ${job.stage}` });
    if (job.steps > 0) { bar.max = job.steps; bar.value = job.step; }
    fill(place, el('p', {}, `${JOBS[job.kind]}: ${job.stage || 'starting'}${job.steps ? `, ${job.step} of ${job.steps}` : ''}${job.note ? ` (${job.note})` : ''}`), bar);
    fill($('doubts'));
    return;
  }
  if (job.error) { fill(place, el('p', { className: 'bad' }, `✕ ${JOBS[job.kind]} failed: ${job.error}`)); return; }
  const r = job.result || {};
  if (job.kind === 'plan') { fill(place); showPlan(r); return; }
  if (job.kind === 'export') { fill(place, el('p', { className: 'good' }, `✓ Written on the robot's computer: ${r.directory}`),
    ...(r.left_out ?? []).map((l) => el('p', { className: 'bad' }, `Left out: ${l.why}`))); return; }
  if (r.doubts) { askDoubts(r.doubts); fill(place, el('p', { className: 'warn' }, '! Nothing was learned yet: judge these doubts first.')); return; }
  // The next training's doubts are judged anew.
  judged.clear();
  fill($('doubts'));
  fill(place, el('p', { className: 'good' }, `✓ Learned from ${many(r.episodes, 'episode')}. The new weights are offered under 4.`),
    ...(r.remarks || []).map(what => remark(what)),
    ...(r.left_out || []).map(([name, what]) => el('p', { className: 'hint' }, `Left out: ${name.split('/').pop()}: ${what}`)));
}

/** Asks of each doubtful episode whether it is used. All of them together are used, or nothing is learned. */
function askDoubts(doubts) {
  const rows = doubts.map(([name, what]) => {
    if (!judged.has(name)) judged.set(name, false);
    const choice = (words, use) => el('label', {}, el('input', { type: 'radio', name: `judged-${name}`, value: use ? 'use' : 'leave', checked: judged.get(name) === use, onchange: () => judged.set(name, use) }), ` ${words}`);
    const all = name === 'data set', file = all ? 'All episodes' : name.split('/').pop();
    return el('div', { className: 'proposal', role: 'radiogroup', 'aria-label': file }, el('p', {}, el('b', {}, file), `: ${what}`),
      el('p', { className: 'row' }, choice(all ? 'Learn nothing: correct the weights in History first' : 'Leave it out', false), choice(all ? 'Use them all the same' : 'Use it all the same', true)));
  });
  fill($('doubts'), ...rows, el('button', { type: 'button', className: 'primary', id: 'learn-judged', onclick: learn }, 'Learn with these answers'));
}

function compare() {
  const w = state.weights || {};
  // An age counts as it is shown: buttons that are made anew each second would swallow clicks.
  const key = JSON.stringify([w, state.table, table.episodes.length], (name, value) => (name === 'age_s' ? ago(value) : value));
  if (key === compareShown) return;
  compareShown = key;
  // The server exchanges what is shown here, or nothing.
  const order = (what, shownFile) => () => attempt(async () => {
    await post('/api/weights', { what, identity: shownFile?.identity || '' });
    mine = true;
    say({ accept: 'The new weights are in use from the next pour on.', back: 'The weights from before are in use from the next pour on.', decline: 'The offer is deleted.' }[what], true);
  });
  const button = (words, what, file, main = false) => el('button', { type: 'button', className: main ? `primary ${what}` : what, onclick: order(what, file) }, words);
  const columns = [['In use', w.now], ['Offered', w.offer], ['From before', w.before]].filter(([, file]) => file);
  const goals = [...new Set(columns.flatMap(([, file]) => (file.expected || []).map(e => e.goal_ml)))].sort((a, b) => a - b);
  const off = (file, goal) => { const sd = (file.expected || []).find(e => e.goal_ml === goal)?.sd_ml; return Number.isFinite(sd) ? `±${shown(sd)} ml` : 'not known'; };
  const line = (name, of) => el('tr', {}, el('th', { scope: 'row' }, name), ...columns.map(([, file]) => el('td', {}, of(file))));
  const facts = [line('Weights', file => (file.error ? `✕ ${file.error}` : file.identity.slice(0, 8))), line('Age', file => (file.error ? '' : ago(file.age_s).replace(' old', ''))),
    line('Learned from', file => (file.error ? '' : many(file.episodes, 'episode'))),
    line('Weighed pours with them', file => (file.error ? '' : poursWith(file.identity))),
    ...goals.map(goal => line(`Expected error, ${shown(goal, 0)} ml`, file => (file.error ? '' : off(file, goal))))];
  fill($('compare'), columns.length ? el('div', { className: 'scroll' }, el('table', {}, el('thead', {}, el('tr', {}, el('td', {}), ...columns.map(([name]) => el('th', { scope: 'col' }, name)))), el('tbody', {}, ...facts)))
    : el('p', {}, 'There is no weight file yet.'),
  el('p', { className: 'hint' }, 'The expected error is one standard deviation, as the weights themselves tell it.'),
  w.offer ? el('p', { className: 'row' }, w.offer.error ? null : button('Use the offered weights', 'accept', w.offer, true), button('Delete the offer', 'decline', w.offer)) : el('p', { className: 'hint' }, 'Nothing is offered: learn first.'),
  w.before && !w.before.error ? button('Go back to those from before', 'back', w.before) : null);
}

/** How far off the weighed pours with some weights were. */
function poursWith(identity) {
  const errors = table.episodes.filter(e => e.weights === identity && Number.isFinite(e.error_ml)).map(e => e.error_ml);
  if (!errors.length) return 'none';
  const rms = Math.sqrt(errors.reduce((a, e) => a + e * e, 0) / errors.length);
  return `${errors.length}, off by ${shown(rms)} ml (root mean square)`;
}

/** How many episodes without a weight are listed. Chosen by hand: who weighs does it at once. */
const LISTED = 12;
/** Rows of episodes without a weight, by file: what is typed there stays while the table changes. */
const toWeigh = new Map();
/** Those that are weighed later. */
const skipped = new Set();

function rowToWeigh(e) {
  const place = el('div', { className: 'proposal' });
  fill(place, el('p', {}, el('b', {}, e.file), ` ${e.started_at_utc}, ${what(e)}`), scale(e.file, e.run.goal_ml ?? NaN, grams => {
    if (grams === null) { skipped.add(e.file); unweighed(); } else reload();
  }, e.poured_ml ?? NaN));
  return place;
}

/** Episodes without a weight, newest first, and what of them is not listed. */
function unweighed() {
  const open = table.episodes.filter(e => !e.error && e.weight_g === null).reverse();
  const whole = open.filter(e => e.complete), cut = open.filter(e => !e.complete && (!e.ended || e.recoverable)).length;
  const lacking = open.length - whole.length - cut;
  // What is wrong with the others stands in History: they are not learned from.
  const weighed = table.episodes.filter(e => !e.error && e.weight_g !== null && !(e.wrong || []).length);
  const kinds = kind => weighed.filter(e => e.run.kind === kind).length;
  $('set-words').textContent = table.fault ? `! ${table.fault}.` : `Weighed so far: ${many(kinds('recording'), 'curve')} and ${many(kinds('pour'), 'pour')}${table.unread ? `; ${many(table.unread, 'file')} still to be read` : ''}.`;
  const old = plannedFrom !== null && plannedFrom !== weighed.length;
  $('plan-old').textContent = old ? `! This was proposed from ${many(plannedFrom, 'weighed episode')}; now there ${weighed.length === 1 ? 'is' : 'are'} ${weighed.length}: propose again.` : '';
  for (const file of toWeigh.keys()) if (!whole.some(e => e.file === file)) toWeigh.delete(file);
  const asked = whole.filter(e => !skipped.has(e.file)), listed = asked.slice(0, LISTED);
  for (const e of listed) if (!toWeigh.has(e.file)) toWeigh.set(e.file, rowToWeigh(e));
  const rest = [table.fault ? `! ${table.fault}.` : null, table.unread ? `${many(table.unread, 'file')} still to be read.` : null,
    asked.length > LISTED ? `${asked.length - LISTED} older ones are not weighed either: History shows all.` : null,
    whole.length > asked.length ? `${whole.length - asked.length} skipped: not weighed.` : null,
    cut ? `${many(cut, 'episode')} without a weight ${cut === 1 ? 'was' : 'were'} cut or ${cut === 1 ? 'is' : 'are'} still being recorded, and cannot be weighed: \`decant episodes recover\` makes a cut one whole.` : null,
    lacking ? `${many(lacking, 'episode')} without a weight ${lacking === 1 ? 'lacks' : 'lack'} something, and ${lacking === 1 ? 'teaches' : 'teach'} nothing: History says what.` : null].filter(line => line);
  const all = !open.length && !rest.length ? [table.episodes.length ? 'Everything that was recorded is weighed.' : 'Nothing has been recorded yet.'] : rest;
  keepRows($('unweighed'), listed.map(e => toWeigh.get(e.file)), all);
}

/** Puts rows and lines into `parent`. Rows that are there already are not touched, so that the focus and what is typed stay. */
function keepRows(parent, rows, lines) {
  [...parent.children].filter(child => !rows.includes(child)).forEach(child => child.remove());
  rows.forEach((row, k) => { if (parent.children[k] !== row) parent.insertBefore(row, parent.children[k] ?? null); });
  parent.append(...lines.map(line => el('p', { className: 'hint' }, line)));
}

function what(episode) {
  const run = episode.run || {};
  if (run.kind === 'pour') return `pour of ${goalWords(run.goal_ml)} ml`;
  return run.kind === 'recording' ? `curve of ${shown(run.lambda_deg, 0)}°` : 'table';
}

async function reload() {
  try { table = await get('/api/episodes'); } catch { tableShown = ''; return; }
  dispatchEvent(new CustomEvent('table'));
}
addEventListener('table', unweighed);
listeners.push(() => {
  showJob(state.job);
  compare();
  if (state.table !== tableShown) { tableShown = state.table; reload(); }
});
addEventListener('tab', async event => {
  if (event.detail !== 'learn') return;
  unweighed();
  try { showPlan(await get('/api/plan')); } catch { return; }
});
addEventListener('known', () => { $('holds').value = about.holds_ml ?? kept('decant-holds'); });
