// The fourth tab: the steps of `feature-worker calibrate`, which does the work.
//
// Runs in the browser's one thread, and asks the server how far it is while the tab is shown. What calibrate refuses is said in its words.
'use strict';

let found = null, pin = 'lip', calibrationShown = '', calibrationBusy = false;

const order4 = (what, more = {}) => attempt(async () => {
  const answer = await post('/api/calibrate', { what, ...more });
  mine = true;
  return answer.words;
});
$('watch').onclick = async () => {
  const seconds = Math.floor(typed('watch-seconds') ?? 0);
  if (!(seconds > 0)) { say('Type for how many seconds the camera is watched.'); return; }
  found = null;
  $('spot').hidden = $('measure').hidden = $('calibrate-write').hidden = true;
  $('calibrate-section').textContent = '';
  if (await order4($('watch-method').value, { seconds })) { calibrationBusy = true; look(); }
};
$('watch-cancel').onclick = () => order4('cancel');
$('curve').onclick = () => attempt(async () => {
  const [height, width] = [typed('curve-height'), typed('curve-width')];
  if (!(height > 0 && width > 0)) throw new Error('Type height and width of the curve, above 0.');
  await postMotion('/api/record', { lambda_deg: height, gamma_per_s2: width });
  mine = true;
});

/** Asks how far the calibration has come. */
async function look() {
  let now;
  try { now = await get('/api/calibration'); } catch {
    // A server that is slow for once is asked again.
    if (calibrationBusy && !$('calibrate').hidden) setTimeout(look, 700);
    return;
  }
  calibrationBusy = now.busy;
  const key = JSON.stringify(now);
  if (key !== calibrationShown) {
    calibrationShown = key;
    const end = now.ended === null ? [] : [el('p', { className: now.ended ? 'good' : 'bad' }, now.ended ? '✓ It is written.' : '✕ It has ended; nothing more is written.')];
    fill($('calibrate-lines'), ...now.lines.map(line => el('p', {}, line)), now.busy && !now.found ? el('progress', { 'aria-label': 'Watching and measuring' }) : null, ...end);
    // Another page may have measured again: what is shown is what would be written.
    if (now.found && now.found.section !== found?.section) show(now.found);
    if (!now.found) $('calibrate-write').hidden = $('measure').hidden = true;
  }
  if (calibrationBusy && !$('calibrate').hidden) setTimeout(look, 700);
}

function show(state4) {
  found = state4;
  $('calibrate-section').textContent = found.section;
  showSpot(found);
  $('spot').hidden = $('measure').hidden = $('calibrate-write').hidden = false;
  pins();
}

/** Shows the picture of what was found, unless something else was found meanwhile. */
async function showSpot(of) {
  let picture = null;
  try { picture = await (await getPicture('/api/calibration.jpg')).blob(); } catch { /* Then there is none to be seen. */ }
  if (found === of) put($('spot-picture'), picture);
}

/** The points were moved: what was measured with them elsewhere cannot be written. */
function moved() {
  $('calibrate-write').hidden = true;
  pins();
}

/** Puts the three points where they are. */
function pins() {
  $('spot').querySelectorAll('.pin').forEach(p => p.remove());
  ['lip', 'rim', 'foot'].forEach((name, k) => {
    const dot = el('span', { className: 'pin' }, k + 1);
    dot.style.left = `${found[name][0] / found.width * 100}%`;
    dot.style.top = `${found[name][1] / found.height * 100}%`;
    dot.setAttribute('aria-hidden', 'true');
    $('spot').append(dot);
  });
}
function pick(name) {
  pin = name;
  document.querySelectorAll('[data-pin]').forEach(b => b.setAttribute('aria-pressed', b.dataset.pin === name));
}
document.querySelectorAll('[data-pin]').forEach(b => { b.onclick = () => pick(b.dataset.pin); });
$('spot').onclick = event => {
  const box = $('spot-picture').getBoundingClientRect();
  found[pin] = [(event.clientX - box.left) * found.width / box.width, (event.clientY - box.top) * found.height / box.height];
  moved();
  pick({ lip: 'rim', rim: 'foot', foot: 'lip' }[pin]);
};
$('spot').onkeydown = event => {
  const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  if (event.key === 'Enter') { measure(); return; }
  if (!move || !found) return;
  event.preventDefault();
  const by = event.shiftKey ? 10 : 1;
  found[pin] = found[pin].map((v, k) => v + by * move[k]);
  moved();
  $('announce').textContent = `${pin} at ${found[pin].map(v => v.toFixed(0)).join(', ')}`;
};
async function measure() {
  const { lip, rim, foot } = found;
  say('Measuring again …', true);
  const words = await order4('corner', { corner: { lip, rim, foot } });
  if (words === undefined) return;
  const good = words.startsWith('measured again');
  say(words, good);
  if (!good) return;
  found = null;
  calibrationShown = '';
  look();
}
$('measure').onclick = measure;
$('calibrate-write').onclick = async () => {
  const words = await order4('write', { section: found?.section ?? '' });
  if (words !== undefined) { say(words, words.startsWith('written')); look(); }
};
addEventListener('tab', event => { if (event.detail === 'calibrate') look(); });
