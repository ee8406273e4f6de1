//! The HTTP door: tells how the gateway is, and takes no orders.

mod door;
mod events;
mod page;
mod patience;

use std::net::SocketAddr;
use std::sync::Arc;

use anyhow::Context;
use axum::body::Body;
use axum::extract::{Path, State};
use axum::http::{HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router, middleware};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;

use crate::edge::clock::Clock;
use crate::edge::metrics;
use crate::edge::reports::{Detail, NoRecording, Reporter};
use crate::engine::health::Status;
use crate::engine::recorder::files;
use door::Door;
use events::Hub;
use patience::PatientListener;

/// An address that is taken, but not yet answered on.
pub struct Bound {
    listener: TcpListener,
    address: SocketAddr,
    /// As it stands in the configuration.
    host: String,
}

/// The running server.
pub struct Http {
    address: SocketAddr,
    tasks: [JoinHandle<()>; 2],
}

impl Http {
    /// Takes the address `listen`, as `127.0.0.1:8485`; port 0 takes a free one.
    pub async fn bind(listen: &str) -> anyhow::Result<Bound> {
        let listener =
            TcpListener::bind(listen).await.with_context(|| format!("HTTP cannot listen on {listen}"))?;
        let address = listener.local_addr().context("the HTTP listener has no address")?;
        let host = listen.rsplit_once(':').map_or(listen, |(host, _)| host).to_string();
        Ok(Bound { listener, address, host })
    }

    /// Answers from now on, to everything but `/health` only those who know the token. Only within a
    /// runtime.
    pub fn serve(bound: Bound, reporter: Arc<Reporter>, clock: Clock, token: Option<String>) -> Http {
        // Whoever can reach an address of this machine alone is on it.
        let own_name = bound.address.ip().is_loopback().then_some(bound.host);
        let hub = Arc::new(Hub::default());
        let telling = tokio::spawn(events::tell(hub.clone(), reporter.clone(), clock));
        let router = Router::new()
            .route("/", get(page::page))
            .route("/health", get(health))
            .route("/metrics", get(metrics))
            .route("/api/devices", get(devices))
            .route("/api/buses", get(buses))
            .route("/api/buses/{bus}/frames.pcapng", get(frames))
            .route("/api/events", get(events))
            .with_state(Shared { reporter, clock, hub })
            .layer(middleware::from_fn_with_state(Arc::new(Door::new(token, own_name)), door::pass));
        let server = tokio::spawn(async move {
            if let Err(error) = axum::serve(PatientListener::new(bound.listener), router).await {
                tracing::warn!("the HTTP server has ended: {error}");
            }
        });
        Http { address: bound.address, tasks: [server, telling] }
    }

    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Stops, and waits until the address is free again.
    pub async fn finish(self) {
        for task in self.tasks {
            task.abort();
            // It ends with an error, since it was told to.
            let _ = task.await;
        }
    }

    pub fn stop(self) {
        self.tasks.iter().for_each(JoinHandle::abort);
    }
}

#[derive(Clone)]
struct Shared {
    reporter: Arc<Reporter>,
    clock: Clock,
    hub: Arc<Hub>,
}

async fn health(State(shared): State<Shared>) -> Response {
    let report = shared.reporter.report(Detail::Devices).await;
    let code = match report.status() {
        Status::Ok | Status::Degraded => StatusCode::OK,
        Status::Lost => StatusCode::SERVICE_UNAVAILABLE,
    };
    (code, Json(report.to_json())).into_response()
}

async fn metrics(State(shared): State<Shared>) -> Response {
    match metrics::render(shared.reporter.report(Detail::Readings).await) {
        Ok(text) => ([(header::CONTENT_TYPE, metrics::CONTENT_TYPE)], text).into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    }
}

async fn devices(State(shared): State<Shared>) -> Response {
    let report = shared.reporter.report(Detail::Points).await;
    // After the answer: what a stuck bus said last has grown older while we waited for it.
    Json(report.devices_json(shared.clock.now())).into_response()
}

async fn buses(State(shared): State<Shared>) -> Response {
    Json(shared.reporter.report(Detail::Devices).await.buses_json()).into_response()
}

/// What was last on the wire of a bus, as a file for Wireshark.
async fn frames(State(shared): State<Shared>, Path(bus): Path<String>) -> Response {
    let recording = match shared.reporter.recording(&bus).await {
        Ok(recording) => recording,
        Err(NoRecording::NoSuchBus) => {
            return (StatusCode::NOT_FOUND, "there is no such bus; /api/buses lists them\n").into_response();
        }
        Err(NoRecording::Off) => {
            let reason = "nothing is recorded; the configuration says `kilobytes: 0` under `recorder`\n";
            return (StatusCode::NOT_FOUND, reason).into_response();
        }
        Err(NoRecording::Stuck) => {
            return (StatusCode::SERVICE_UNAVAILABLE, "the bus does not answer\n").into_response();
        }
    };
    let (file, _) = recording.to_pcapng(shared.clock.since_1970_at(recording.made_at));
    let name = files::name(&recording.bus, shared.clock.today(), &[]);
    let headers = [
        (header::CONTENT_TYPE, "application/x-pcapng".to_string()),
        (header::CONTENT_DISPOSITION, format!("attachment; filename=\"{name}\"")),
    ];
    (headers, file).into_response()
}

async fn events(State(shared): State<Shared>) -> Response {
    let Some(stream) = shared.hub.join() else {
        return (StatusCode::SERVICE_UNAVAILABLE, "too many are watching already\n").into_response();
    };
    // A proxy in between that collects what it passes on would keep the news back.
    let headers =
        [(header::CONTENT_TYPE, "text/event-stream"), (HeaderName::from_static("x-accel-buffering"), "no")];
    (headers, Body::new(stream)).into_response()
}
