/* What the gateway tells, and the way on which it comes. */
function take_point(device, told, at) {
  let row = device.rows.get(told.name);
  if (!row) {
    row = point_row(told, device.rows.size);
    device.rows.set(told.name, row);
  }
  row.told = told;
  row.read_at = told.read_seconds_ago === null ? null : at - told.read_seconds_ago;
  show_point(device, row);
}
function take_device(told, at) {
  let device = devices.get(told.name);
  if (!device) {
    device = device_card(told);
    devices.set(told.name, device);
  }
  device.told = told;
  device.answered_at = told.last_answer_seconds_ago === null ? null : at - told.last_answer_seconds_ago;
  for (const point of told.points || []) take_point(device, point, at);
  show_device(device);
}
function take_bus(bus, at) {
  const before = buses.get(bus.name);
  if (before && at > before.at && bus.requests >= before.requests) {
    const samples = rates.get(bus.name) || [];
    samples.push([seconds(), (bus.requests - before.requests) / (at - before.at)]);
    while (samples.length > RATES_MAX) samples.shift();
    rates.set(bus.name, samples);
  }
  bus.at = at;
  buses.set(bus.name, bus);
}
const take = {
  state(told) {
    offset = seconds() - told.now;
    gateway = told;
    /* What is open stays open. */
    const open = new Set([...document.querySelectorAll('.device details[open]')].map((group) => group.parentNode.id + ' ' + group.className));
    for (const known of [buses, devices, lines]) known.clear();
    for (const device of told.devices) take_device(device, told.at);
    for (const device of devices.values()) {
      for (const group of device.card.querySelectorAll('details')) {
        if (open.has(device.card.id + ' ' + group.className)) group.open = true;
      }
    }
    summary_card = null;
    show_gateway();
    $('lines').replaceChildren(summary_card.card);
    for (const bus of told.buses) {
      take_bus(bus, told.at);
      lines.set(bus.name, bus_card(bus.name));
      $('lines').append(lines.get(bus.name).card);
    }
    arrange(true);
    if (location.hash && !open.size) document.getElementById(location.hash.slice(1))?.scrollIntoView();
  },
  gateway(told) {
    gateway = {...gateway, status: told.status, broker: told.broker};
  },
  bus(told) {
    take_bus(told.bus, told.at);
  },
  device(told) {
    take_device(told.device, told.at);
  },
  points(told) {
    const device = devices.get(told.device);
    for (const point of told.points) take_point(device, point, told.at);
    show_device(device);
  },
  read(told) {
    const rows = devices.get(told.device).rows;
    for (const read of told.reads) {
      for (const name of read.points) rows.get(name).read_at = told.at - read.seconds_ago;
    }
  },
};
function hear(event, data) {
  const told = JSON.parse(data);
  offset = Math.min(offset, seconds() - (told.now ?? told.at));
  if (take[event] && (gateway || event === 'state')) take[event](told);
}

/* What goes by with time. */
function tick() {
  arrange(false);
  if (!gateway) return;
  show_gateway();
  buses.forEach(show_bus);
  for (const device of devices.values()) {
    const age = age_of(device.answered_at);
    put(device.right, age === null ? 'no answer yet' : device.told.online ? age_text(age) : `last answer ${age_text(age)} ago`);
    device.rows.forEach(show_age);
    if (Math.floor(seconds()) % 5 === 0) device.rows.forEach((row) => show_trend(device, row));
  }
}

/* The connection. `EventSource` cannot show a token, so the stream is read by hand. */
let token = sessionStorage.getItem('token'), hurry = null;
function show_connection(now_live, why) {
  is_live = now_live;
  document.body.classList.toggle('lost', !is_live && gateway !== null);
  $('lost').hidden = is_live || gateway === null;
  if (is_live) put($('live'), 'live');
  else {
    put($('live'), why);
    const since = heard_at === null ? '' : new Date(heard_at * 1000).toLocaleTimeString();
    put($('lost'), `No news from the gateway (${why}). What is shown here is as it was at ${since}.`);
    document.title = 'no news · busker';
    if (gateway === null) put($('status').children[1], why);
    else { mark($('status').children[0], 'unknown'); put($('status').children[1], 'no news from the gateway'); }
  }
}
async function listen() {
  const stop = new AbortController();
  heard_at = gateway ? heard_at : null;
  const silence = setInterval(() => {
    if (last_byte_at + SILENCE_MAX < seconds()) stop.abort();
  }, 1000);
  let last_byte_at = seconds(), ticking = null;
  try {
    const headers = token ? {Authorization: 'Bearer ' + token} : {};
    const answer = await fetch('api/events', {headers, signal: stop.signal, cache: 'no-store'});
    if (answer.status === 401) return 'token';
    if (!answer.ok) return `it answers with status ${answer.status}`;
    const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
    for (let waiting = '';;) {
      const {value, done} = await reader.read();
      if (done) return 'the connection has ended';
      last_byte_at = heard_at = seconds();
      const parts = (waiting + value).split('\n\n');
      waiting = parts.pop();
      is_live = true;
      for (const part of parts) {
        const event = /^event: (.*)$/m.exec(part), data = /^data: (.*)$/m.exec(part);
        if (event && data) hear(event[1], data[1]);
      }
      if (gateway && !ticking) {
        show_connection(true);
        ticking = setInterval(tick, 1000);
        tick();
      }
    }
  } catch (error) {
    return stop.signal.aborted ? 'it has fallen silent' : error instanceof TypeError ? 'it cannot be reached' : String(error);
  } finally {
    clearInterval(silence);
    clearInterval(ticking);
    stop.abort();
  }
}
async function run() {
  for (;;) {
    const why = await listen();
    if (why === 'token') {
      $('wrong').hidden = token === null;
      $('login').hidden = false;
      put($('status').children[1], 'a token is needed');
      $('token').focus();
      await new Promise((resolve) => { hurry = resolve; });
      continue;
    }
    show_connection(false, why);
    /* While nothing is heard, things grow older all the same. */
    tick();
    await new Promise((resolve) => setTimeout(resolve, 2000));
  }
}
$('login').addEventListener('submit', (event) => {
  event.preventDefault();
  token = $('token').value.trim();
  sessionStorage.setItem('token', token);
  $('login').hidden = true;
  if (hurry) hurry();
});
addEventListener('resize', () => arrange(false));
run();
