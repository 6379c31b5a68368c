'use strict';
const picture = document.getElementById('picture'), state = document.getElementById('state');
const canvas = document.getElementById('history'), pen = canvas.getContext('2d');
function plot(values) {
  pen.fillStyle = '#111'; pen.fillRect(0, 0, canvas.width, canvas.height);
  const top = Math.max(100, ...values);
  pen.fillStyle = '#999'; pen.fillText('V_e, up to ' + top.toFixed(0) + ' px², newest at the right', 6, 12);
  pen.strokeStyle = '#ff0'; pen.beginPath();
  values.forEach((v, i) => pen.lineTo(canvas.width - (values.length - i) * canvas.width / 300, canvas.height - 4 - v / top * (canvas.height - 24)));
  pen.stroke();
}
async function step() {
  try {
    const s = await (await fetch('/state.json')).json();
    if (s.unshown) state.textContent = `${s.unshown}: look at the camera's driver`;
    if (s.sequence) {
      state.textContent = (s.silent ? 'no frames for a second; the last one: ' : s.unshown ? `${s.unshown}; the last one that could be shown: ` : '') + `frame ${s.sequence}   V_e ${s.area_px2.toFixed(0)} px²   confidence ${s.confidence.toFixed(2)}   doubt: ${s.doubt}`;
      plot(s.history);
      picture.src = '/picture.jpg?' + s.sequence;
    }
    setTimeout(step, 66);
  } catch { state.textContent = 'the view has ended'; setTimeout(step, 1000); }
}
step();
