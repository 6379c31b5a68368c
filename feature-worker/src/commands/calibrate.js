'use strict';
const picture = document.getElementById('picture'), word = document.getElementById('word');
let chosen = 'lip', state = {}, measured = false;
function choose(point) {
  chosen = point;
  document.querySelectorAll('[data-point]').forEach(b => b.classList.toggle('on', b.dataset.point === point));
}
function place() {
  for (const point of ['lip', 'rim', 'foot']) {
    const dot = document.getElementById(point);
    dot.style.left = state[point][0] + 'px'; dot.style.top = state[point][1] + 'px';
  }
}
async function load() {
  state = await (await fetch('/state.json')).json();
  picture.width = state.width;
  picture.src = '/picture.jpg?' + Date.now();
  document.getElementById('section').textContent = state.section;
  place();
  measured = true;
}
document.querySelectorAll('[data-point]').forEach(b => b.onclick = () => choose(b.dataset.point));
document.getElementById('frame').onclick = async event => {
  const box = picture.getBoundingClientRect();
  state[chosen] = [(event.clientX - box.left) * state.width / box.width, (event.clientY - box.top) * state.height / box.height];
  place();
  measured = false;
  word.textContent = 'measuring ...';
  const { lip, rim, foot } = state;
  word.textContent = await (await fetch('/corner', { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify({ lip, rim, foot }) })).text();
  choose({ lip: 'rim', rim: 'foot', foot: 'lip' }[chosen]);
  if (word.textContent.startsWith('measured again')) load();
};
document.getElementById('write').onclick = async () => {
  if (!measured) { word.textContent = 'not written: the dots are not where the section has the corner; move them until it is measured, or load the page again'; return; }
  word.textContent = await (await fetch('/write', { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify({ section: state.section }) })).text();
};
choose('lip'); load();
