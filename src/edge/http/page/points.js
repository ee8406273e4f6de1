/* A row for each point: its value with its age, its trend, its curve. */
function point_row(told, index) {
  const trend = element('div', {className: 'trend'}), value = element('td', {className: 'value'}), age = element('td', {className: 'age'});
  const name = element('th', {scope: 'row', title: told.name}, element('div', null, element('span', null, told.title), trend));
  return {told, index, tr: element('tr', null, name, value, age), trend, value, age, read_at: null, group: null, figure: null};
}
function show_point(device, row) {
  const {told} = row, is_missing = told.missing !== null;
  const is_curve = !is_missing && Array.isArray(told.list);
  const group = told.missing === 'not_in_this_mode' ? 'asleep' : told.role === 'event' ? 'value' : told.role;
  if (row.group !== group) {
    const body = device.groups[group].body;
    const next = [...body.children].find((other) => other.index > row.index);
    row.tr.index = row.index;
    body.insertBefore(row.tr, next || null);
    row.group = group;
    show_groups(device);
  }
  const is = element('span', {className: 'is'});
  if (is_missing) is.append(DASH);
  else if (told.value === 'ON' || told.value === 'OFF') {
    is.classList.add('flag');
    is.classList.toggle('on', told.value === 'ON');
    is.append(told.value);
  } else {
    is.append(told.value);
    if (told.unit && is_number(told.value)) is.append('\u00a0', element('span', {className: 'unit'}, told.unit));
  }
  row.value.replaceChildren(is);
  /* The device's own reason stands above all of them. */
  if (is_missing && told.reason && told.missing !== 'offline') row.value.prepend(element('span', {className: 'reason'}, told.reason));
  remember(device, row);
  show_trend(device, row);
  row.tr.hidden = is_curve;
  show_figure(device, row, is_curve);
  show_age(row);
}
function show_age(row) {
  const {told} = row, age = age_of(row.read_at);
  let freshness = told.freshness;
  /* Nobody need tell us that time goes by, or that nobody tells us anything. */
  if (freshness === 'fresh' && (!is_live || age > told.good_for_seconds)) freshness = 'old';
  if (row.tr.className !== freshness) row.tr.className = freshness;
  const text = told.missing === null ? age_text(age) : '';
  put(row.age, text);
  if (row.figure) {
    put(row.figure.age, text ? text + ' ago' : '');
    if (row.figure.element.className !== freshness) row.figure.element.className = freshness;
  }
}
function show_groups(device) {
  for (const {group, summary, body, title} of Object.values(device.groups)) {
    const sleeping = group.className === 'asleep' ? device.asleep.children.length : 0;
    group.hidden = body.children.length + sleeping === 0;
    put(summary, `${title} (${body.children.length + sleeping})`);
  }
}
function show_figure(device, row, is_curve) {
  if (!is_curve) {
    if (row.figure) row.figure.element.remove();
    row.figure = null;
    return;
  }
  const age = element('span', {className: 'age'});
  const figure = element('figure', null, element('figcaption', null, row.told.title, age), curve(row.told.list, row.told.unit, row.told.title));
  figure.index = row.index;
  if (row.figure) row.figure.element.replaceWith(figure);
  else device.curves.insertBefore(figure, [...device.curves.children].find((other) => other.index > row.index) || null);
  row.figure = {element: figure, age};
}
function remember(device, row) {
  const {told} = row, key = device.told.name + '/' + told.name;
  const value = told.missing !== null || told.freshness === 'old' ? null
    : told.value === 'ON' ? 1 : told.value === 'OFF' ? 0
    : is_number(told.value) ? Number(told.value) : null;
  const samples = trends.get(key) || [];
  if (samples.length === 0 && value === null) return;
  if (samples.length === 0 || samples[samples.length - 1][1] !== value) samples.push([seconds(), value]);
  while (samples.length > TREND_STEPS) samples.shift();
  trends.set(key, samples);
}
function show_trend(device, row) {
  const samples = trends.get(device.told.name + '/' + row.told.name) || [];
  /* A line that never moves says nothing. */
  if (new Set(samples.map((sample) => sample[1]).filter((value) => value !== null)).size < 2) {
    row.trend.replaceChildren();
    return;
  }
  const until = seconds(), from = Math.max(until - TREND_SECONDS, samples[0][0]);
  spark(row.trend, samples, from, until, false);
}
