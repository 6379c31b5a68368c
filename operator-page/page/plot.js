// Plots on a canvas: panels over one time axis. Series differ by dash as well as by colour, and each panel names them in words.
//
// Runs in the browser's one thread whenever its caller draws; a plot of a minute takes some milliseconds. Numbers that are not known leave gaps,
// and nothing fails.
'use strict';

const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const DASHES = [[], [6, 4], [2, 3], [10, 3, 2, 3]];

/** The canvas's pen, in CSS pixels, on an empty canvas. */
function pen(canvas) {
  const ratio = devicePixelRatio || 1, height = Number(canvas.dataset.height || canvas.getAttribute('height'));
  canvas.dataset.height = height;
  const width = canvas.clientWidth || 600;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    canvas.style.height = `${height}px`;
  }
  const p = canvas.getContext('2d');
  p.setTransform(ratio, 0, 0, ratio, 0, 0);
  p.clearRect(0, 0, width, height);
  p.font = '12px system-ui, sans-serif';
  p.lineJoin = 'round';
  return { p, width, height };
}

/** A round step for about `count` lines over `span`. */
function step(span, count) {
  const rough = span / Math.max(1, count), power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map(m => m * power).find(s => s >= rough);
}

/** The lowest and highest value, with room, never empty. */
function range(panel) {
  let low = panel.low ?? Infinity, high = panel.high ?? -Infinity;
  for (const series of panel.series) {
    for (const [, v, sd = 0] of series.points) {
      if (Number.isFinite(v)) { low = Math.min(low, v - sd); high = Math.max(high, v + sd); }
    }
  }
  if (!Number.isFinite(low) || !Number.isFinite(high)) return [0, 1];
  if (high - low < 1e-6) high = low + 1;
  return [low, high + (high - low) * 0.06];
}

/**
 * Draws panels: `{ title, unit, low, high, series: [{ name, colour, dash, points: [[t, value, sd]] }], marks: [{ t, text }] }`.
 * `cursor` is a time that is marked; `axis` names the time axis.
 */
function panels(canvas, { from, to, list, cursor, axis }) {
  const { p, width, height } = pen(canvas);
  const ink = css('--ink'), soft = css('--soft'), grid = css('--grid');
  const left = 46, right = width - 8, foot = 22, gap = 22, each = (height - foot) / list.length;
  const x = t => left + (t - from) / (to - from || 1) * (right - left);
  const by = step(to - from, width / 90);
  p.textBaseline = 'alphabetic'; p.fillStyle = soft; p.lineWidth = 1; p.strokeStyle = grid;
  for (let t = Math.ceil(from / by) * by; t <= to + by / 1e6; t += by) {
    list.forEach((panel, k) => { p.beginPath(); p.moveTo(x(t), k * each + gap); p.lineTo(x(t), (k + 1) * each - 4); p.stroke(); });
    p.textAlign = 'center'; p.fillText(axis ? axis(t) : `${Number(t.toPrecision(6))} s`, Math.min(Math.max(x(t), left), right - 12), height - 6);
  }
  list.forEach((panel, k) => {
    const top = k * each + gap, bottom = (k + 1) * each - 4;
    const [low, high] = range(panel);
    const y = v => bottom - (v - low) / (high - low) * (bottom - top);
    const lines = step(high - low, (bottom - top) / 26);
    p.textBaseline = 'middle'; p.lineWidth = 1;
    for (let v = Math.ceil(low / lines) * lines; v <= high; v += lines) {
      p.strokeStyle = grid; p.beginPath(); p.moveTo(left, y(v)); p.lineTo(right, y(v)); p.stroke();
      p.fillStyle = soft; p.textAlign = 'right';
      p.fillText(String(Number(v.toPrecision(6))), left - 5, y(v));
    }
    let at = left;
    p.textAlign = 'left'; p.fillStyle = ink;
    p.fillText(`${panel.title}, ${panel.unit}`, at, top - 11);
    at += p.measureText(`${panel.title}, ${panel.unit}`).width + 14;
    p.save(); p.beginPath(); p.rect(left, top - 2, right - left, bottom - top + 4); p.clip();
    for (const mark of panel.marks || []) {
      p.fillStyle = css('--warn'); p.textAlign = 'center';
      p.fillText('×', x(mark.t), bottom - 6);
    }
    for (const series of panel.series) line(p, series, x, y);
    p.restore();
    p.setLineDash([]);
    for (const series of panel.series) {
      p.strokeStyle = css(series.colour); p.lineWidth = 2; p.setLineDash(DASHES[series.dash || 0]);
      p.beginPath(); p.moveTo(at, top - 11); p.lineTo(at + 26, top - 11); p.stroke(); p.setLineDash([]);
      p.fillStyle = ink; p.textAlign = 'left'; p.fillText(series.name, at + 31, top - 11);
      at += 31 + p.measureText(series.name).width + 14;
    }
    if ((panel.marks || []).length) { p.fillStyle = css('--warn'); p.fillText('× doubtful', at, top - 11); }
  });
  if (Number.isFinite(cursor)) {
    p.strokeStyle = ink; p.lineWidth = 1; p.beginPath(); p.moveTo(x(cursor), gap); p.lineTo(x(cursor), height - foot); p.stroke();
  }
}

/** One series: its band of one standard deviation, and its line, with gaps where nothing is known; or dots. */
function line(p, series, x, y) {
  const colour = css(series.colour);
  if (series.points.some(([, , sd]) => sd > 0)) {
    const known = series.points.filter(([, v]) => Number.isFinite(v));
    p.fillStyle = colour; p.globalAlpha = 0.22; p.beginPath();
    known.forEach(([t, v, sd = 0]) => p.lineTo(x(t), y(v + sd)));
    known.reverse().forEach(([t, v, sd = 0]) => p.lineTo(x(t), y(v - sd)));
    p.fill(); p.globalAlpha = 1;
  }
  p.strokeStyle = colour; p.fillStyle = colour; p.lineWidth = 1.8; p.setLineDash(DASHES[series.dash || 0]);
  if (series.dots) {
    for (const [t, v] of series.points) {
      if (!Number.isFinite(v)) continue;
      p.beginPath(); p.arc(x(t), y(v), 4, 0, 7); p.fill();
    }
    return;
  }
  p.beginPath();
  let open = false;
  for (const [t, v] of series.points) {
    if (!Number.isFinite(v)) { open = series.bridge ? open : false; continue; }
    if (open) p.lineTo(x(t), y(v)); else p.moveTo(x(t), y(v));
    open = true;
  }
  p.stroke();
  p.setLineDash([]);
}

/** A histogram of `bins` ([upper edge, count]), the counts on a logarithmic axis. */
function histogram(canvas, bins, unit) {
  const { p, width, height } = pen(canvas);
  if (!bins.length) return;
  const foot = 18, most = Math.log10(Math.max(...bins.map(b => b[1])) + 1), each = (width - 8) / bins.length;
  p.fillStyle = css('--series-1');
  bins.forEach(([, n], k) => {
    const high = Math.max(1, Math.log10(n + 1) / most * (height - foot - 4));
    p.fillRect(4 + k * each, height - foot - high, Math.max(1, each - 1), high);
  });
  p.fillStyle = css('--soft'); p.textBaseline = 'alphabetic';
  const every = Math.ceil(bins.length / Math.max(1, Math.floor(width / 70)));
  bins.forEach(([edge], k) => {
    if (k % every === 0) { p.textAlign = 'left'; p.fillText(`${edge < 10 ? edge.toFixed(1) : edge.toFixed(0)}`, 4 + k * each, height - 4); }
  });
  p.textAlign = 'right'; p.fillText(unit, width - 4, 10);
}
