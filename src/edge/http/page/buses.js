/* A card for the gateway and its broker, and one for each bus. */
const lines = new Map();
let summary_card = null;

function fact(name, value, state) {
  return element('span', {className: state || ''}, element('b', null, value), ' ' + name);
}
function show_gateway() {
  const {status, broker, version} = gateway;
  const bad_buses = [...buses.values()].filter((bus) => !bus.up || !bus.responding);
  const all = [...devices.values()], off = all.filter((device) => !device.told.online);
  const says = [];
  if (!broker.connected) says.push('the broker is lost');
  for (const bus of bad_buses) says.push(`bus ${bus.name} ${bus.up ? 'does not respond' : 'is down'}`);
  if (off.length) says.push(`${off.length} of ${all.length} devices ${off.length === 1 ? 'is' : 'are'} offline`);
  if (!says.length) says.push(all.length === 0 ? 'no devices' : all.length === 1 ? 'the one device answers' : `all ${all.length} devices answer`);
  if (is_live) {
    const [dot, text] = $('status').children;
    mark(dot, {ok: 'good', degraded: 'warn', lost: 'bad'}[status] || 'unknown');
    put(text, `${status}: ${says.join(', ')}`);
    document.title = `${status} · busker`;
  }
  if (!summary_card) {
    const dot = element('span', {className: 'dot'}), right = element('span', {className: 'right'});
    const why = element('p', {className: 'why'}), list = element('dl');
    const card = element('article', {className: 'card', id: 'gateway'},
      element('div', {className: 'head'}, dot, element('h2', null, 'Gateway'), right), list, why);
    const facts = {};
    for (const name of ['running for', 'broker', 'connections made', 'messages dropped', 'devices that answer', 'values known']) {
      facts[name] = element('dd');
      list.append(element('dt', null, name), facts[name]);
    }
    summary_card = {card, dot, right, why, facts};
  }
  const {dot: lamp, right, why, facts} = summary_card;
  mark(lamp, is_live && {ok: 'good', degraded: 'warn', lost: 'bad'}[status] || 'unknown');
  put(right, 'busker ' + version);
  put(facts['running for'], is_live ? age_text(seconds() - offset) : DASH);
  put(facts.broker, broker.connected ? 'connected' : 'not connected');
  facts.broker.className = broker.connected ? '' : 'bad';
  put(facts['connections made'], count(broker.connects));
  put(facts['messages dropped'], count(broker.dropped));
  facts['messages dropped'].className = broker.dropped ? 'warn' : '';
  put(facts['devices that answer'], `${all.length - off.length} of ${all.length}`);
  const rows = all.flatMap((device) => [...device.rows.values()]).filter((row) => row.told.missing !== 'not_in_this_mode' && row.told.missing !== 'on_request' && row.told.missing !== 'no_event');
  put(facts['values known'], `${rows.filter((row) => row.told.missing === null).length} of ${rows.length}`);
  why.hidden = broker.connected;
  put(why, 'The broker is not connected: ' + (broker.reason || 'nobody knows why'));
}
function bus_card(name) {
  const dot = element('span', {className: 'dot'}), right = element('span', {className: 'right'});
  const why = element('p', {className: 'why'}), bar = element('i'), load = element('span', {className: 'small soft'});
  const track = element('div', {className: 'bar', role: 'img'}, bar);
  const rate = element('div'), facts = element('p', {className: 'facts'}), chips = element('nav', {className: 'chips'});
  chips.setAttribute('aria-label', 'Devices on ' + name);
  const link = element('p', {className: 'about'});
  const tape = element('a', {href: `api/buses/${name}/frames.pcapng`, className: 'tape', title: 'What was last on the wire, as a file for Wireshark'}, 'last frames (pcapng)');
  tape.addEventListener('click', (event) => {
    event.preventDefault();
    download(tape);
  });
  const card = element('article', {className: 'card bus'},
    element('div', {className: 'head'}, dot, element('h2', null, name), right), link, why,
    element('div', {className: 'load'}, track, load), rate, facts, chips, tape);
  return {card, dot, right, link, why, bar, track, load, rate, facts, chips};
}
/* A link by itself cannot show a token, so the file is fetched first. */
async function download(link) {
  const told = link.textContent;
  try {
    const answer = await fetch(link.href, {headers: token ? {Authorization: 'Bearer ' + token} : {}, cache: 'no-store'});
    if (!answer.ok) throw new Error((await answer.text()).trim());
    const name = /filename="([^"]+)"/.exec(answer.headers.get('content-disposition'));
    const url = URL.createObjectURL(await answer.blob());
    element('a', {href: url, download: name ? name[1] : 'frames.pcapng'}).click();
    setTimeout(() => URL.revokeObjectURL(url), 10000);
  } catch (error) {
    put(link, error.message);
    setTimeout(() => put(link, told), 5000);
  }
}
function slowest(bus, class_) {
  const real = bus.devices.map((name) => devices.get(name)).filter((device) => device && device.told.periods[class_])
    .map((device) => device.told.periods[class_]).filter((period) => period.seconds !== null);
  if (!real.length) return [null, 1];
  return [Math.max(...real.map((period) => period.seconds)), Math.max(...real.map((period) => period.seconds / period.wanted_seconds))];
}
function show_bus(bus) {
  const line = lines.get(bus.name);
  const is_well = bus.up && bus.responding && is_live;
  mark(line.dot, is_well ? 'good' : is_live ? 'bad' : 'unknown');
  const samples = rates.get(bus.name) || [];
  const last = is_well && samples.length ? samples[samples.length - 1][1] : null;
  put(line.right, number(last, 1) + ' requests/s');
  put(line.link, bus.link + (bus.line ? ' · ' + bus.line : ''));
  line.why.hidden = bus.up && bus.responding && !bus.reason;
  put(line.why, !bus.up ? bus.reason || 'the link is down' : !bus.responding ? 'The bus does not respond: what is shown of it is what it said last.' : bus.reason || '');
  const percent = is_well ? Math.round(bus.load * 100) : null;
  put(line.load, (percent === null ? DASH : percent + ' %') + ' load');
  line.bar.style.width = (percent || 0) + '%';
  line.bar.className = percent >= 90 ? 'bad' : percent >= 70 ? 'warn' : '';
  line.track.setAttribute('aria-label', percent === null ? 'The load is not known' : `The line was busy for ${percent} % of the last minute`);
  const began = samples.length ? samples[0][0] : seconds();
  spark(line.rate, samples, Math.max(began, seconds() - RATES_MAX), seconds(), true);
  const wrong = bus.checksum_errors + bus.wrong_frames + bus.collisions;
  line.facts.replaceChildren(
    fact('requests', count(bus.requests)),
    fact('timeouts', count(bus.timeouts), bus.timeouts ? 'warn' : ''),
    fact('damaged', count(wrong), wrong ? 'warn' : ''),
    fact('exceptions', count(bus.exceptions), bus.exceptions ? 'warn' : ''),
    fact('late', count(bus.late_replies), bus.late_replies ? 'warn' : ''),
    ...['fast', 'slow'].map((class_) => {
      const [real, stretch] = slowest(bus, class_);
      return fact(class_ + ' period', period_text(real), stretch > 1.5 ? 'warn' : '');
    }));
  line.chips.replaceChildren(...bus.devices.map((name) => {
    const device = devices.get(name);
    const dot = element('span', {className: 'dot ' + (device && device.told.online ? 'good' : 'bad')});
    const title = device ? device.told.title : name;
    const state = device && device.told.online ? '' : ', offline';
    return element('a', {href: '#device-' + name, title: title + state}, dot,
      element('span', null, title, element('span', {className: 'unseen'}, state)));
  }));
}
