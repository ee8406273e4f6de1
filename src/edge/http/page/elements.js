/* What everything is made of: elements, numbers and curves. Texts go in as texts: what a device says of itself is no markup. */
function element(tag, properties, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties || {})) {
    if (name in made && name !== 'list') made[name] = value; else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}
function drawing(tag, attributes, ...children) {
  const made = document.createElementNS('http://www.w3.org/2000/svg', tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}
function put(place, text) {
  if (place.textContent !== text) place.textContent = text;
}
function mark(place, state) {
  place.className = 'dot ' + state;
}

/* Numbers for people. */
function age_text(age) {
  if (age === null || !isFinite(age)) return '';
  /* Rounded up, so never younger than it is; in steps, so that what is well stands still. */
  for (const step of [3, 5, 10, 15, 20, 30, 45, 60, 90, 120]) if (age <= step) return step + ' s';
  const whole = Math.ceil(age);
  if (whole < 7200) return Math.ceil(whole / 60) + ' min';
  if (whole < 172800) return Math.ceil(whole / 3600) + ' h';
  return Math.ceil(whole / 86400) + ' d';
}
function number(value, digits) {
  return value === null || value === undefined || !isFinite(value) ? DASH : value.toFixed(digits);
}
function count(value) {
  return value === null || value === undefined ? DASH : String(value).replace(/\B(?=(\d{3})+$)/g, '\u202f');
}
function period_text(value) {
  if (value === null || value === undefined) return DASH;
  return value < 1 ? Math.round(value * 1000) + ' ms' : (value < 10 ? value.toFixed(1) : Math.round(value)) + ' s';
}
/* A time of the gateway's clock as an age now. */
function age_of(told_at) {
  return told_at === null ? null : Math.max(0, seconds() - offset - told_at);
}

/* Curves. */
function spark(place, samples, from, until, fill) {
  /* `samples`: [time, number or null], each holding until the next. */
  const width = 100, height = 16;
  const numbers = samples.filter((sample) => sample[1] !== null).map((sample) => sample[1]);
  place.replaceChildren();
  if (numbers.length === 0) return;
  const low = fill ? 0 : Math.min(...numbers), high = Math.max(...numbers, fill ? 1e-9 : -Infinity);
  const x = (time) => Math.max(0, (time - from) / (until - from) * width);
  const y = (value) => high === low ? height / 2 : height - 1 - (value - low) / (high - low) * (height - 2);
  let path = '', pen_is_up = true;
  samples.forEach(([time, value], index) => {
    const next = index + 1 < samples.length ? samples[index + 1][0] : until;
    if (value === null || next < from) { pen_is_up = true; return; }
    path += (pen_is_up ? 'M' : 'L') + x(time).toFixed(1) + ' ' + y(value).toFixed(1);
    path += 'H' + x(next).toFixed(1);
    pen_is_up = false;
  });
  const svg = drawing('svg', {class: fill ? 'rate' : 'trend', viewBox: `0 0 ${width} ${height}`, preserveAspectRatio: 'none', 'aria-hidden': 'true'});
  if (fill && path) {
    const first = samples.find((sample) => sample[1] !== null);
    svg.append(drawing('path', {class: 'area', d: path + `V${height}H${x(first[0]).toFixed(1)}Z`}));
  }
  svg.append(drawing('path', {d: path}));
  place.append(svg);
}
function curve(list, unit, title) {
  /* A list of numbers, some of which may be missing, with its axes. */
  const left = 56, right = 398, top = 8, bottom = 118;
  const numbers = list.filter((value) => typeof value === 'number');
  const tail = unit ? ' ' + unit : '';
  if (numbers.length === 0) return element('p', {className: 'soft small'}, 'All of its values are missing.');
  let low = Math.min(...numbers), high = Math.max(...numbers);
  /* For who cannot see it. */
  const label = `${title}: ${numbers.length} values from ${low} to ${high}${tail}`;
  if (low === high) { low -= 1; high += 1; }
  const x = (index) => left + (list.length < 2 ? 0 : index / (list.length - 1) * (right - left));
  const y = (value) => bottom - (value - low) / (high - low) * (bottom - top);
  const svg = drawing('svg', {viewBox: '0 0 400 140', role: 'img', 'aria-label': label});
  const digits = high - low < 1 ? 3 : high - low < 20 ? 1 : 0;
  const ticks = low < 0 && high > 0 ? [low, 0, high] : [low, (low + high) / 2, high];
  for (const tick of ticks) {
    svg.append(drawing('line', {class: tick === 0 ? 'zero' : '', x1: left, x2: right, y1: y(tick), y2: y(tick)}));
    svg.append(drawing('text', {x: left - 6, y: y(tick) + 4, 'text-anchor': 'end'}, tick.toFixed(tick === 0 ? 0 : digits) + (tick === ticks[2] ? tail : '')));
  }
  let path = '', pen_is_up = true;
  list.forEach((value, index) => {
    if (typeof value !== 'number') { pen_is_up = true; return; }
    path += (pen_is_up ? 'M' : 'L') + x(index).toFixed(1) + ' ' + y(value).toFixed(1);
    pen_is_up = false;
  });
  svg.append(drawing('path', {d: path}));
  svg.append(drawing('text', {x: left, y: 134}, '1'));
  svg.append(drawing('text', {x: (left + right) / 2, y: 134, 'text-anchor': 'middle'}, 'value'));
  svg.append(drawing('text', {x: right, y: 134, 'text-anchor': 'end'}, String(list.length)));
  return svg;
}
