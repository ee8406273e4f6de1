//! What `busker check` forecasts of a bus of Modbus TCP, held against the program's own bus: there a request takes
//! its round trip, as it is measured and told as `turnaround`.

use std::collections::BTreeMap;

use busker::engine::bus::{Action, Bus, Command, Event};
use busker::engine::memory::Memories;
use busker::engine::modbus::{Answer, Call, Discarded, Reply};
use busker::engine::time::{Duration, Time};

use super::{check, settings};

const WITHIN: f64 = 0.05;

struct Case {
    what: &'static str,
    /// In microseconds.
    round_trip: u64,
    devices: usize,
    poll: &'static str,
    /// So many registers lie together, and then so many do not matter.
    clusters: [usize; 2],
}

/// What a minute on the network brought.
struct Found {
    load: f64,
    /// Of each read, by its unit and first register, in seconds.
    periods: BTreeMap<(u8, u16), f64>,
    worst_wait: f64,
    turnaround: f64,
}

impl Case {
    fn configuration(&self) -> String {
        let [together, apart] = self.clusters;
        let register = |number: usize| number / together * (together + apart) + number % together;
        let write = |number: usize| if number == 0 { ", write: 0..65535" } else { "" };
        let points: Vec<String> = (0..100)
            .map(|number| {
                format!(
                    "p{number}: {{at: holding {}, type: u16, poll: fast{}}}",
                    register(number),
                    write(number)
                )
            })
            .collect();
        let mut text =
            String::from("buses: {net: {tcp: \"10.0.0.1:502\", response_timeout: 2s}}\ndevices:\n");
        for unit in 1..=self.devices {
            text += &format!(
                "  unit_{unit}: {{bus: net, unit: {unit}, poll: {{{}}}, points: {{{}}}}}\n",
                self.poll,
                points.join(", ")
            );
        }
        text
    }

    fn live(&self) -> Found {
        let settings = settings(&self.configuration());
        let mut bus = Bus::new(Time(0), &settings, 0, &Memories::default());
        let (mut now, end) = (Time(0), Time::from_millis(150_000));
        let (settled, crowded) = (Time::from_millis(60_000), Time::from_millis(120_000));
        let mut load = 0.0;
        let mut asked: BTreeMap<(u8, u16), Vec<Time>> = BTreeMap::new();
        let (mut worst_wait, mut came_at, mut number) = (0.0_f64, Time(0), 0_u16);
        bus.handle(now, Event::LinkUp);
        while now < end {
            let sent = std::iter::from_fn(|| bus.next_action()).find_map(|action| match action {
                Action::Send { request, .. } => Some(request),
                _ => None,
            });
            let Some(request) = sent else {
                now = bus.wake_at().expect("polls without end").max(now);
                bus.handle(now, Event::Wake);
                continue;
            };
            let sent_at = now;
            let answer = match request.call {
                Call::Read(span) => {
                    // Until its plans are those of the devices that there are.
                    if now > settled && now < crowded {
                        asked.entry((request.unit, span.first())).or_default().push(now);
                    }
                    Answer::Words(vec![0; span.count() as usize])
                }
                _ => {
                    worst_wait = worst_wait.max(sent_at.since(came_at).as_secs_f64());
                    Answer::Written
                }
            };
            if now >= crowded && load == 0.0 {
                load = bus.report(now).load;
            }
            // At the end somebody wants something now and then, just when a request has gone out.
            if now > crowded && now.since(came_at) > Duration::from_millis(311) {
                (came_at, number) = (now + Duration::from_micros(1), number + 1);
                let (device, point) = ("unit_1".into(), "p0".into());
                let command = Command { device, point, payload: number.to_string(), retained: false };
                bus.handle(came_at, Event::Command(command));
                // It is on its way, and cannot be taken back.
                let sends = |action| matches!(action, Action::Send { .. });
                assert!(!std::iter::from_fn(|| bus.next_action()).any(sends));
            }
            now += Duration::from_micros(self.round_trip);
            let reply = Reply::new(Ok(answer), sent_at, Some((now, now)), &mut Discarded::default());
            bus.handle(now, Event::Reply(reply));
        }
        let mean =
            |times: &[Time]| times[times.len() - 1].since(times[0]).as_secs_f64() / (times.len() - 1) as f64;
        let report = bus.report(now);
        let turnaround = report.timing.turnaround.and_then(|told| told.lately).expect("it has answered");
        Found {
            load,
            periods: asked.iter().map(|(read, times)| (*read, mean(times))).collect(),
            worst_wait,
            turnaround: turnaround.p50.as_secs_f64(),
        }
    }
}

#[test]
fn on_modbus_tcp_load_periods_and_waits_are_those_of_the_running_bus() {
    for case in [
        Case { what: "as W6", round_trip: 1_280, devices: 1, poll: "fast: 1ms", clusters: [100, 0] },
        Case {
            what: "a gateway of ten",
            round_trip: 8_000,
            devices: 10,
            poll: "fast: 50ms",
            clusters: [100, 0],
        },
        Case { what: "time to spare", round_trip: 700, devices: 3, poll: "fast: 50ms", clusters: [100, 0] },
        Case { what: "several reads", round_trip: 2_000, devices: 2, poll: "fast: 5ms", clusters: [10, 90] },
        Case {
            what: "a satellite",
            round_trip: 600_000,
            devices: 1,
            poll: "fast: 500ms",
            clusters: [100, 0],
        },
    ] {
        let what = case.what;
        let found = case.live();
        let agree = |figure: &str, forecast: f64, found: f64| {
            let off = forecast / found - 1.0;
            assert!(off.abs() <= WITHIN, "{what}: {figure}: forecast {forecast:.5}, found {found:.5}");
        };
        agree("turnaround", found.turnaround, case.round_trip as f64 / 1e6);
        // With what the program itself says of its devices, as a person would ask.
        let turnaround = format!("{}ms", (found.turnaround * 1e6).round() / 1e3);
        let forecast = check(&case.configuration(), &["--turnaround", &turnaround])["buses"][0].clone();
        let seconds = |value: &serde_json::Value| value.as_f64().expect("a number");
        agree("load", seconds(&forecast["load"]).min(1.0), found.load);
        for ((unit, _), period) in &found.periods {
            let poll = &forecast["devices"][usize::from(*unit) - 1]["polls"]["fast"];
            agree("period", seconds(&poll["real_period"]), *period);
            let reads = found.periods.keys().filter(|(of, _)| of == unit).count();
            assert_eq!(poll["reads"], reads, "{what}");
        }
        agree("wait of a command", seconds(&forecast["command_wait"]), found.worst_wait);
    }
}
