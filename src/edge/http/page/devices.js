/* A card for each device, with its things and points. */
const GROUPS = [['value', 'Values'], ['setting', 'Settings'], ['diagnostic', 'More'], ['asleep', 'Not in this mode']];

function device_card(told) {
  const dot = element('span', {className: 'dot'}), right = element('span', {className: 'right'});
  const about = element('p', {className: 'about'}), why = element('p', {className: 'why'});
  const drift = element('div');
  const things = element('div', {className: 'things'}), curves = element('div');
  const card = element('article', {className: 'card device', id: 'device-' + told.name},
    element('div', {className: 'head'}, dot, element('h3', null, told.title), right), about, why, drift, things);
  const asleep = element('div', {className: 'things'});
  const groups = {}, folds = element('div', {className: 'folds'});
  for (const [name, title] of GROUPS) {
    const body = element('tbody'), summary = element('summary', null, title);
    const table = element('table', null, element('caption', {className: 'unseen'}, `${told.title}, ${title}: name, value and age`),
      element('colgroup', null, element('col'), element('col', {className: 'value'}), element('col', {className: 'age'})), body);
    const group = element('details', {className: name}, summary, table);
    if (name === 'asleep') summary.after(asleep);
    group.open = name === 'value';
    groups[name] = {group, summary, body, title};
    (name === 'value' ? card : folds).append(group);
  }
  card.append(curves, folds);
  const wire = element('p', {className: 'facts'});
  folds.append(element('details', {className: 'wire'}, element('summary', null, 'On the wire'), wire));
  return {told, card, dot, right, about, why, drift, things, asleep, curves, groups, wire, rows: new Map(), answered_at: null};
}
function show_device(device) {
  const {told} = device;
  mark(device.dot, told.online ? 'good' : 'bad');
  if (device.card.classList.contains('offline') === told.online) {
    device.card.classList.toggle('offline', !told.online);
    device.groups.value.group.open = told.online;
  }
  const made_by = [told.manufacturer, told.model].filter(Boolean).join(' ');
  /* What the device says of itself mostly begins with that. */
  const whose = told.identity && made_by && told.identity.includes(told.model) ? told.identity : [made_by, told.identity].filter(Boolean).join(', ');
  put(device.about, [whose || told.profile, `${told.bus} unit ${told.unit}`].filter(Boolean).join(' · '));
  device.why.hidden = !told.reason;
  put(device.why, (told.online ? '' : 'offline: ') + (told.reason || ''));
  device.drift.replaceChildren(...told.drift.map((drift) => element('p', {className: 'why'},
    `${drift.point} holds ${drift.found === null ? DASH : drift.found}, wanted is ${drift.wanted}` + (drift.reason ? ': ' + drift.reason : ''))));
  /* A thing of another mode is kept where the points of other modes are. */
  const sleeps = (thing) => thing.missing === 'not_in_this_mode';
  device.things.replaceChildren(...told.things.filter((thing) => !sleeps(thing)).map((thing) => thing_row(device, thing)));
  device.things.hidden = !device.things.firstChild;
  device.asleep.replaceChildren(...told.things.filter(sleeps).map((thing) => thing_row(device, thing)));
  show_groups(device);
  const counters = told.counters, periods = Object.entries(told.periods).map(([name, period]) =>
    fact(`${name}, ${period_text(period.wanted_seconds)} wanted`, period_text(period.seconds),
      period.seconds > 1.5 * period.wanted_seconds ? 'warn' : ''));
  device.wire.replaceChildren(...periods,
    fact('turnaround (95 % within)', told.turnaround_seconds.p95 === null ? DASH : period_text(told.turnaround_seconds.p95)),
    ...Object.entries(counters).map(([name, value]) => fact(name.replace(/_/g, ' '), count(value))));
}
function thing_row(device, thing) {
  const row = element('div', {className: 'thing ' + thing.freshness}, element('span', null, thing.title));
  const beside = [];
  for (const name of [thing.temperature, thing.target]) {
    const held = name && device.rows.get(name);
    if (name) beside.push(held && held.told.missing === null ? with_unit(held.told) : DASH);
  }
  if (beside.length) row.append(element('span', {className: 'soft'}, beside.join(' → ')));
  const state = thing.state === null ? DASH : thing.state;
  row.append(element('span', {className: 'state'}, state));
  if (thing.state === null && thing.reason) row.append(element('span', {className: 'small soft'}, thing.reason));
  return row;
}
/* A name among numbers (`automatic`) has no unit. */
function is_number(text) {
  return /^-?\d+(\.\d+)?$/.test(text);
}
function with_unit(told) {
  return told.unit && is_number(told.value) ? told.value + '\u00a0' + told.unit : told.value;
}

/* All cards in columns: each goes where there is most room, and stays there. */
let column_count = 0;
function arrange(anew) {
  const wanted = Math.max(1, Math.min(5, Math.floor((document.body.clientWidth - 28) / 400)));
  if (wanted === column_count && !anew) return;
  column_count = wanted;
  $('devices').style.setProperty('--columns', wanted);
  const columns = Array.from({length: wanted}, () => element('div', {className: 'column'}));
  $('devices').replaceChildren(...columns);
  for (const device of devices.values()) {
    const shortest = columns.reduce((best, other) => other.offsetHeight + 40 < best.offsetHeight ? other : best);
    shortest.append(device.card);
  }
}
