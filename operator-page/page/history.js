// The third tab: error over time, the table of episodes, one episode on a scrubber, exports.
//
// Runs in the browser's one thread when its tab is shown, the table changes or the scrubber moves; one picture is asked for at a time. An episode
// that cannot be read stands in the table with its reason.
'use strict';

const numeric = (value, digits) => (value === null || value === undefined ? '' : shown(value, digits));
const COLUMNS = [
  ['file', 'Episode', e => e.file], ['started_at_utc', 'Started (UTC)', e => (e.started_at_utc || '').replace('T', ' ').slice(0, 19)],
  ['what', 'What', e => (e.error ? 'UNREADABLE' : what(e))], ['goal', 'Goal, ml', e => (Number.isFinite(e.run?.goal_ml) ? goalWords(e.run.goal_ml) : ''), true],
  ['weight_g', 'Weight, g', e => numeric(e.weight_g, 1), true], ['error_ml', 'Error, ml', e => numeric(e.error_ml, 1), true],
  ['seconds', 'Time, s', e => numeric(e.seconds, 1), true], ['reason', 'How it ended', e => reasonWords(e), false, true],
  ['doubts', 'Doubts', e => doubtWords(e), false, true], ['weights', 'Weights', e => (e.weights || '').slice(0, 8)],
];
/** Most rows that are shown, and exported as what is shown. Chosen by hand: a browser lays them out at once, and their names fit into a request. */
const ROWS = 500;
let sorted = ['started_at_utc', -1], chosen = '', rows = null, pictureAt = -1;

function doubtWords(e) {
  const doubtful = Object.entries(e.doubtful_frames || {}).map(([name, n]) => `${name}: ${n}`);
  return [...doubtful, ...(e.lost_frames ? [`lost: ${e.lost_frames}`] : []), ...(e.wrong || [])].join('; ');
}

/** Why a pour ended, as the controller said; a page that was not there only knows what the recorder wrote. */
function reasonWords(e) {
  if (e.error) return e.error;
  if (e.reason) return e.complete || !e.ended ? e.reason : `${e.reason}; incomplete: ${e.ended}`;
  if (!e.complete && e.ended) return `incomplete: ${e.ended}`;
  return e.ended ? `recorded to its end (${e.ended})` : 'the recorder was killed';
}

const valueOf = (e, key) => (key === 'goal' ? e.run?.goal_ml : key === 'what' ? what(e) : key === 'doubts' ? doubtWords(e) : key === 'reason' ? reasonWords(e) : e[key]);

/** As text, the ten thousandth episode would come before the second. */
const byNumber = new Intl.Collator('en', { numeric: true }).compare;

function shownEpisodes() {
  const kind = $('kind').value, word = $('search').value.trim().toLowerCase();
  const fits = e => (!kind || (kind === 'unweighed' ? !e.error && e.weight_g === null : kind === 'wrong' ? e.error || (e.wrong || []).length : e.run?.kind === kind)) &&
    (!word || COLUMNS.some(([, , text]) => String(text(e)).toLowerCase().includes(word)));
  const [key, direction] = sorted;
  const order = (a, b) => {
    const [x, y] = [valueOf(a, key), valueOf(b, key)];
    if (x === y) return 0;
    if (x === null || x === undefined || x === '') return 1;
    if (y === null || y === undefined || y === '') return -1;
    return (key === 'file' ? byNumber(x, y) : x < y ? -1 : 1) * direction;
  };
  return table.episodes.filter(fits).sort(order);
}

function showTable() {
  if ($('history').hidden) return;
  const list = shownEpisodes();
  $('table-words').textContent = `Episodes: ${list.length} of ${table.episodes.length} in ${table.directory || '…'}${table.unread ? `; still to be read: ${table.unread}` : ''}.${list.length > ROWS ? ` The first ${ROWS} of them are shown, in this order.` : ''}${table.fault ? ` ${table.fault}.` : ''}`;
  $('table-words').className = table.fault ? 'bad' : 'hint';
  fill($('table').tHead, el('tr', {}, ...COLUMNS.map(([key, name, , number]) => {
    const on = sorted[0] === key;
    const head = el('th', { scope: 'col', className: number ? 'number' : '', 'aria-sort': on ? (sorted[1] > 0 ? 'ascending' : 'descending') : 'none' },
      el('button', { type: 'button', onclick: () => { sorted = [key, on ? -sorted[1] : 1]; showTable(); } }, `${name}${on ? (sorted[1] > 0 ? ' ▲' : ' ▼') : ''}`));
    return head;
  }), el('th', { scope: 'col' }, 'Save')));
  fill($('table').tBodies[0], ...list.slice(0, ROWS).map(e => {
    const look = el('button', { type: 'button', className: 'small look', 'aria-label': `Look at ${e.file}`, onclick: () => open(e.file) }, e.file);
    const cells = COLUMNS.map(([key, , text, number, words]) => el('td', { className: number ? 'number' : words ? 'words' : '' }, key === 'file' && !e.error ? look : text(e)));
    const saved = (path, ending) => el('button', { type: 'button', className: 'small', 'aria-label': `Save ${e.file} as ${ending}`,
      onclick: () => attempt(() => save(`${path}?file=${encodeURIComponent(e.file)}`, e.file.replace(/\.mcap$/, ending))) }, ending.slice(1).toUpperCase());
    const tr = el('tr', { className: e.file === chosen ? 'chosen' : '' }, ...cells,
      el('td', {}, saved('/api/mcap', '.mcap'), ' ', e.error ? null : saved('/api/csv', '.csv')));
    return tr;
  }));
  drift();
}

function drift() {
  const weighed = table.episodes.filter(e => Number.isFinite(e.error_ml)).sort((a, b) => (a.started_at_utc < b.started_at_utc ? -1 : 1));
  if (!weighed.length) { $('drift-words').textContent = 'No pour has been weighed yet.'; pen($('drift')); return; }
  const errors = weighed.map((e, k) => [k + 1, e.error_ml]);
  const mean = errors.map(([k]) => { const near = errors.slice(Math.max(0, k - 5), k).map(e => Math.abs(e[1])); return [k, near.reduce((a, b) => a + b, 0) / near.length]; });
  const top = Math.max(3, ...errors.map(e => Math.abs(e[1])));
  panels($('drift'), { from: 0.5, to: errors.length + 0.5, axis: k => (Number.isInteger(k) ? String(k) : ''), list: [{ title: 'Weight minus goal', unit: 'ml', low: -top, high: top, series: [
    { name: 'one pour', colour: '--series-1', dots: true, points: errors }, { name: 'mean size of the last 5', colour: '--series-2', dash: 1, points: mean }] }] });
  const recent = mean[mean.length - 1][1];
  $('drift-words').textContent = `${errors.length} weighed pour${errors.length > 1 ? 's' : ''}; the last was off by ${shown(errors[errors.length - 1][1])} ml, the last ${Math.min(5, errors.length)} by ${shown(recent)} ml on average.`;
}

async function open(file) {
  rows = await attempt(() => get(`/api/rows?file=${encodeURIComponent(file)}`));
  if (!rows) return;
  chosen = file;
  $('episode').hidden = false;
  $('episode-title').textContent = file;
  const e = table.episodes.find(one => one.file === file) || {};
  const facts = [['What', what(e)], ['Started', e.started_at_utc], ['Goal', e.run?.goal_ml ? `${goalWords(e.run.goal_ml)} ml` : '–'], ['Weight', e.weight_g === null ? 'not weighed' : `${shown(e.weight_g)} g`],
    ['Error', Number.isFinite(e.error_ml) ? `${shown(e.error_ml)} ml` : '–'], ['Time', `${shown(e.seconds)} s, ${e.frames} frames`], ['It ended', reasonWords(e)], ['By the estimate', e.estimate || '–'],
    ['Weights', e.weights || 'none'], ['Doubts', doubtWords(e) || 'none'], ['Notes', (e.notes || []).join('; ') || 'none']];
  fill($('episode-facts'), ...facts.flatMap(([name, value]) => [el('dt', {}, name), el('dd', {}, value)]));
  $('scrub').max = rows.t_s.length - 1;
  const flowing = rows.area_px2.reduce((best, v, k) => (Number.isFinite(v) && v > (rows.area_px2[best] || 0) ? k : best), 0);
  $('scrub').value = flowing;
  pictureAt = -1;
  scrub();
  showTable();
  $('episode').scrollIntoView({ block: 'nearest' });
}

let loading = false;
function scrub() {
  if (!rows || !rows.t_s.length) return;
  const k = Number($('scrub').value);
  const words = `${shown(rows.t_s[k], 2)} s: alpha ${shown(rows.alpha_deg[k])}° commanded, ${shown(rows.alpha_measured_deg[k])}° measured, V_e ${shown(rows.area_px2[k], 0)} px²${rows.doubt[k] === 'none' ? '' : `, DOUBT: ${rows.doubt[k]}`}.`;
  $('scrub-words').textContent = words;
  $('scrub').setAttribute('aria-valuetext', words);
  const of = column => rows.t_s.map((t, i) => [t, rows[column][i] ?? NaN]);
  const marks = rows.t_s.filter((t, i) => rows.doubt[i] !== 'none').map(t => ({ t }));
  panels($('episode-plot'), { from: rows.t_s[0], to: rows.t_s[rows.t_s.length - 1], cursor: rows.t_s[k], list: [
    { title: 'Tilt alpha', unit: 'degrees', low: 0, high: 20, series: [{ name: 'commanded', colour: '--series-1', points: of('alpha_deg') }, { name: 'measured', colour: '--series-2', dash: 1, points: of('alpha_measured_deg') }] },
    { title: 'Stream V_e', unit: 'px²', low: 0, high: 100, marks, series: [{ name: 'V_e', colour: '--series-3', points: of('area_px2') }] }] });
  if (loading || pictureAt === k) return;
  loading = true;
  pictureAt = k;
  showPicture(k).finally(() => { loading = false; if (Number($('scrub').value) !== pictureAt) scrub(); });
}

/** Shows the picture of row `k`, and says when it is another frame's or there is none. */
async function showPicture(k) {
  const image = $('episode-picture'), words = $('episode-picture-words'), of = chosen, at = `${shown(rows.t_s[k], 2)} s`;
  const wanted = rows.sequence[k] % 2 ** 32;
  let picture = null, said = '';
  try {
    const response = await getPicture(`/api/frame?file=${encodeURIComponent(of)}&sequence=${rows.sequence[k]}`);
    const { sequence } = JSON.parse(response.headers.get('x-frame'));
    if (sequence !== wanted) said = `There is no picture of this frame; that of frame ${sequence}, the nearest ${sequence < wanted ? 'before' : 'after'} it, is shown.`;
    picture = await response.blob();
  } catch (error) {
    said = `No picture: ${error instanceof TypeError || error instanceof DOMException ? 'the page\'s server cannot be reached' : error.message}.`;
  }
  put(image, picture);
  image.hidden = !picture;
  image.alt = said ? `Picture of ${of}. ${said}` : `Picture of ${of} at ${at}`;
  words.textContent = said;
}
$('scrub').oninput = scrub;
$('kind').onchange = showTable;
$('search').oninput = showTable;
for (const button of document.querySelectorAll('[data-format]')) {
  button.onclick = () => attempt(async () => {
    const files = shownEpisodes().slice(0, ROWS).filter(e => !e.error).map(e => e.file);
    await post('/api/export', { what: button.dataset.format, files });
    mine = true;
  });
}
addEventListener('table', showTable);
addEventListener('tab', event => { if (event.detail === 'history') { showTable(); scrub(); } });
addEventListener('resize', () => { if (!$('history').hidden) { showTable(); scrub(); } });
