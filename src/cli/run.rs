//! `busker run`: the service.

use anyhow::anyhow;

use super::configuration::{ConfigurationArgs, Loaded};
use super::output::counted;
use super::{Failure, log};
use crate::edge::app::App;
use crate::edge::shutdown::{self, Heard, Signals};
use crate::edge::state_files::StateFiles;
use crate::engine::profile::Library;
use crate::engine::settings::Settings;

/// Run the gateway
///
/// It ends in good order on SIGTERM or an interrupt: requests in flight are finished, and the last
/// message says `offline`. On SIGHUP it reads the configuration again: if that is good, only the buses and
/// devices that have changed are started anew; if not, everything goes on as it was.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  busker run --config /etc/busker/busker.yaml")]
pub struct Args {
    #[command(flatten)]
    configuration: ConfigurationArgs,
    /// Listen for HTTP here and not where the configuration says; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS:PORT")]
    http: Option<String>,
}

pub fn run(args: Args) -> Result<(), Failure> {
    log::start();
    // Before anything that takes its time: SIGHUP would end the program.
    let runtime = App::runtime()?;
    let mut signals = runtime
        .block_on(async { Signals::listen() })
        .map_err(|error| anyhow!("signals cannot be heard: {error}"))?;
    let (settings, library) = load(&args).map_err(|failure| failure.so("nothing was started"))?;
    let (buses, devices) = (settings.buses.len(), settings.devices.len());
    let names = settings.devices.iter().map(|device| device.name.as_str());
    let state = StateFiles::open(&settings.state_dir, names)?;
    let mut app = App::start_on(runtime, settings, library, state)?;
    if let Some(address) = app.http_address() {
        tracing::info!("HTTP on http://{address}/health");
    }
    tracing::info!("started with {} on {}", counted(devices, "device"), counted(buses, "bus"));
    shutdown::tell_ready();
    let name = loop {
        match app.wait(&mut signals) {
            Heard::Stop(name) => break name,
            Heard::Reload => reload(&args, &mut app),
        }
    };
    tracing::info!("{name}: stopping");
    shutdown::tell_stopping();
    app.stop();
    Ok(())
}

fn load(args: &Args) -> Result<(Settings, Library), Failure> {
    let Loaded { mut settings, library, .. } = args.configuration.load_with_broker()?;
    if args.http.is_some() {
        settings.http.listen.clone_from(&args.http);
    }
    Ok((settings, library))
}

/// Goes on with the configuration as it is now, if it is good.
fn reload(args: &Args, app: &mut App) {
    tracing::info!("SIGHUP: reading the configuration again");
    shutdown::tell_reloading();
    let result =
        load(args).and_then(|(settings, library)| app.reload(settings, library).map_err(Failure::WrongInput));
    match result {
        Ok(()) => {
            tracing::info!("the configuration is read, and what has changed is at work");
            shutdown::tell_status("");
        }
        Err(failure) => {
            let reason = failure.to_text();
            tracing::error!("the new configuration is refused, and the old one goes on: {reason}");
            shutdown::tell_status("the new configuration is refused, and the old one goes on; see the log");
            app.refuse_reload(&reason);
        }
    }
    shutdown::tell_ready();
}
