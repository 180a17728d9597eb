// Small plots of training: loss, PSNR and clicks over time.
import {make, setAttribute, setText} from './dom.js';
import {duration} from './model.js';

const kWidth = 200;
const kHeight = 40;

/// Points of a polyline in kWidth x kHeight, at most 400; `values` may have gaps (null). logarithmic: of a falling loss.
export function polyline(times, values, logarithmic) {
  const rows = times.map((t, i) => [t, values[i]]).filter(([, v]) => Number.isFinite(v) && (!logarithmic || v > 0));
  if (rows.length < 2) return '';
  const height = (v) => (logarithmic ? Math.log(v) : v);
  const heights = rows.map(([, v]) => height(v));
  const [low, high] = [Math.min(...heights), Math.max(...heights)];
  const [first, last] = [rows[0][0], rows.at(-1)[0]];
  const every = Math.ceil(rows.length / 400);
  return rows.filter((_, i) => i % every === 0 || i + 1 === rows.length).map(([t, v]) => {
    const x = (kWidth * (t - first)) / Math.max(1e-9, last - first);
    const y = high > low ? kHeight - 2 - ((kHeight - 4) * (height(v) - low)) / (high - low) : kHeight / 2;
    return `${x.toFixed(1)},${y.toFixed(1)}`;
  }).join(' ');
}

const kPlots = [
  {name: 'Loss', column: 1, logarithmic: true, text: (v) => v.toPrecision(3)},
  {name: 'PSNR', column: 2, text: (v) => `${v.toFixed(1)} dB`},
  {name: 'Clicks', column: 3, text: (v) => String(v)},
];

export class Plots {
  constructor(element) {
    this.rows = kPlots.map((plot) => {
      const value = make('b');
      const range = make('small');
      const line = make('svg:polyline', {points: ''});
      const svg = make('svg:svg', {viewBox: `0 0 ${kWidth} ${kHeight}`, preserveAspectRatio: 'none', role: 'img'}, line);
      element.append(make('figure', {}, make('figcaption', {}, `${plot.name} `, value, range), svg));
      return {...plot, value, range, line, svg};
    });
  }

  update(history) {
    const times = history.map((row) => row[0]);
    for (const {name, column, logarithmic, text, value, range, line, svg} of this.rows) {
      const values = history.map((row) => row[column]);
      const known = values.filter(Number.isFinite);
      const told = known.length ? text(known.at(-1)) : 'none yet';
      const span = times.length > 1 ? duration(times.at(-1) - times[0]) : '';
      setText(value, told);
      setText(range, known.length > 1 ? `from ${text(known[0])}, ${span}` : '');
      setAttribute(line, 'points', polyline(times, values, logarithmic));
      setAttribute(svg, 'aria-label', `${name}: ${told}`);
    }
  }
}
