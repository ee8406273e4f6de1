//! `busker run`: the service.

use super::configuration::{ConfigurationArgs, Loaded};
use super::{Failure, log};
use crate::edge::app::App;
use crate::edge::shutdown;
use crate::edge::state_files::StateFiles;

/// Run the gateway
///
/// It ends in good order on SIGTERM or an interrupt: requests in flight are finished, and the last
/// message says `offline`.
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
    let loaded = args.configuration.load_with_library();
    let Loaded { mut settings, library, .. } = loaded.map_err(|failure| failure.so("nothing was started"))?;
    if args.http.is_some() {
        settings.http.listen = args.http;
    }
    let (buses, devices) = (settings.buses.len(), settings.devices.len());
    let names = settings.devices.iter().map(|device| device.name.as_str());
    let state = StateFiles::open(&settings.state_dir, names)?;
    let app = App::start(settings, library, state)?;
    if let Some(address) = app.http_address() {
        tracing::info!("HTTP on http://{address}/health");
    }
    tracing::info!("started with {devices} devices on {buses} buses");
    shutdown::tell_ready();
    app.wait_for_signal()?;
    shutdown::tell_stopping();
    app.stop();
    Ok(())
}
