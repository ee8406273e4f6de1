//! pymodbus and mbpoll read and write the simulated devices.

use std::path::Path;
use std::process::Command;

use busker::simulator::{Framing, Options, PtyPort, Simulation, TcpPort};

use crate::peers;

/// The four devices with the signals that `client.py` expects.
fn simulation() -> Simulation {
    let devices = [
        "metz-connect/mr-do4@18",
        "metz-connect/mr-ai8@19",
        "metz-connect/mr-si4@20",
        "fuehlersysteme/relay8@7",
    ]
    .map(|device| device.parse().expect("a device"));
    let simulation = Simulation::new(&devices, Options::default()).expect("a simulation");
    for command in [
        "unit 18 relay 2 hand on",
        "unit 19 input 1 ohms 107.794",
        "unit 19 input 2 volts 2.5",
        "unit 20 input 1 counter 78187493530",
        "unit 20 input 4 contact closed",
    ] {
        simulation.command(command).expect(command);
    }
    simulation
}

fn tcp(simulation: &Simulation) -> TcpPort {
    simulation.serve_tcp("127.0.0.1:0", Framing::Tcp).expect("a socket")
}

fn pty(simulation: &Simulation) -> PtyPort {
    simulation.serve_pty(None).expect("a pseudo-terminal")
}

fn check_with_pymodbus(python: &Path, arguments: &[&str]) {
    let output =
        Command::new(python).arg(peers::file("client.py")).args(arguments).output().expect("Python starts");
    let told = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{told}{}", String::from_utf8_lossy(&output.stderr));
    // A client that checks nothing would find no difference either.
    let checks: u32 = told.split_whitespace().next().and_then(|count| count.parse().ok()).unwrap_or(0);
    assert!(checks > 300, "{told}");
}

#[test]
fn pymodbus_reads_and_writes_every_register_of_the_four_devices_over_tcp() {
    let Some(python) = peers::pymodbus() else { return };
    let simulation = simulation();
    let door = tcp(&simulation);
    check_with_pymodbus(&python, &["tcp", "127.0.0.1", &door.address().port().to_string()]);
}

#[test]
fn pymodbus_reads_and_writes_every_register_of_the_four_devices_over_a_serial_line() {
    let Some(python) = peers::pymodbus() else { return };
    let simulation = simulation();
    let line = pty(&simulation);
    check_with_pymodbus(&python, &["rtu", line.path().to_str().expect("a path of text")]);
}

#[test]
fn mbpoll_reads_and_writes_the_four_devices_over_tcp_and_a_serial_line() {
    let Some(mbpoll) = peers::mbpoll() else { return };
    let simulation = simulation();
    let (tcp, line) = (tcp(&simulation), pty(&simulation));
    let port = tcp.address().port().to_string();
    let path = line.path().to_str().expect("a path of text");
    for link in
        [&["-m", "tcp", "-p", &port, "127.0.0.1"][..], &["-m", "rtu", "-b", "19200", "-P", "even", path]]
    {
        for (question, wanted) in QUESTIONS {
            // The values to be written stand behind the line.
            let (options, values) = question.split_once(" = ").unwrap_or((question, ""));
            let mut command = Command::new(&mbpoll);
            command.args(["-0", "-1"]).args(options.split_whitespace()).args(link);
            let output = command.args(values.split_whitespace()).output().expect("mbpoll starts");
            let told = String::from_utf8_lossy(&output.stdout).into_owned()
                + &String::from_utf8_lossy(&output.stderr);
            let told: Vec<&str> = told.split_whitespace().collect();
            let told = told.join(" ");
            assert!(told.contains(wanted), "mbpoll {question} over {link:?}: {told}");
        }
    }
}

/// What mbpoll is asked, perhaps with ` = ` and what it writes, and what it tells then, in one line.
const QUESTIONS: &[(&str, &str)] = &[
    ("-a 18 -t 0 -r 0 = 1 0 0 1", "Written 4 references."),
    ("-a 18 -t 0 -r 0 -c 8", "[0]: 1 [1]: 1 [2]: 0 [3]: 1 [4]: 0 [5]: 1 [6]: 0 [7]: 0"),
    ("-a 18 -t 0 -r 3 = 0", "Written 1 references."),
    ("-a 18 -t 4:hex -r 0 -c 2", "[0]: 0x0023 [1]: 0x0000"),
    ("-a 18 -t 4 -r 66 = 1234", "Written 1 references."),
    ("-a 18 -t 4 -r 66", "[66]: 1234"),
    ("-a 18 -t 4 -r 66 = 0", "Written 1 references."),
    ("-a 18 -t 3 -r 0", "Illegal function"),
    ("-a 18 -t 4 -r 2", "Illegal data address"),
    ("-a 18 -t 0 -r 0 -c 9", "Illegal data value"),
    ("-a 20 -t 1 -r 0 -c 4", "[0]: 0 [1]: 0 [2]: 0 [3]: 1"),
    ("-a 20 -t 3:hex -r 0 -c 3", "[0]: 0x0012 [1]: 0x3456 [2]: 0x789A"),
    ("-a 20 -t 4 -r 12 = 1 2", "Written 2 references."),
    ("-a 20 -t 4:int -B -r 12 -c 1", "[12]: 65538"),
    ("-a 20 -t 4 -r 0 -c 2", "Illegal data address"),
    ("-a 19 -t 3:float -B -r 2 -c 1", "[2]: 2.5"),
    ("-a 19 -t 4 -r 24 = 1 2 3 4", "Written 4 references."),
    ("-a 19 -t 4 -r 24 -c 4", "[24]: 1 [25]: 2 [26]: 3 [27]: 4"),
    ("-a 19 -t 4 -r 16 = 2", "Illegal data value"),
    ("-a 7 -t 3:hex -r 0 -c 10", "[0]: 0x5000"),
    ("-a 7 -t 4 -r 1 = 1 0 1", "Written 3 references."),
    ("-a 7 -t 3 -r 9", "[9]: 5"),
    ("-a 7 -t 4 -r 1 = 11111 11111 11111", "Written 3 references."),
    ("-a 7 -t 3 -r 9", "[9]: 0"),
    ("-a 7 -t 4 -r 0 -c 11", "Illegal data value"),
];
