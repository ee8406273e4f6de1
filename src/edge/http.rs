//! The HTTP door: tells how the gateway is, and takes no orders.

use std::net::SocketAddr;
use std::sync::Arc;

use anyhow::Context;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;

use crate::edge::clock::Clock;
use crate::edge::metrics;
use crate::edge::reports::Reporter;
use crate::engine::health::Status;

/// An address that is taken, but not yet answered on.
pub struct Bound {
    listener: TcpListener,
    address: SocketAddr,
}

/// The running server.
pub struct Http {
    address: SocketAddr,
    server: JoinHandle<()>,
}

impl Http {
    /// Takes the address `listen`, as `127.0.0.1:8485`; port 0 takes a free one.
    pub async fn bind(listen: &str) -> anyhow::Result<Bound> {
        let listener =
            TcpListener::bind(listen).await.with_context(|| format!("HTTP cannot listen on {listen}"))?;
        let address = listener.local_addr().context("the HTTP listener has no address")?;
        Ok(Bound { listener, address })
    }

    /// Answers from now on. Only within a runtime.
    pub fn serve(bound: Bound, reporter: Arc<Reporter>, clock: Clock) -> Http {
        let router = Router::new()
            .route("/health", get(health))
            .route("/metrics", get(metrics))
            .route("/api/devices", get(devices))
            .route("/api/buses", get(buses))
            .with_state(Shared { reporter, clock });
        let server = tokio::spawn(async move {
            if let Err(error) = axum::serve(bound.listener, router).await {
                tracing::warn!("the HTTP server has ended: {error}");
            }
        });
        Http { address: bound.address, server }
    }

    pub fn address(&self) -> SocketAddr {
        self.address
    }

    pub fn stop(self) {
        self.server.abort();
    }
}

#[derive(Clone)]
struct Shared {
    reporter: Arc<Reporter>,
    clock: Clock,
}

async fn health(State(shared): State<Shared>) -> Response {
    let report = shared.reporter.report().await;
    let code = match report.status() {
        Status::Ok | Status::Degraded => StatusCode::OK,
        Status::Lost => StatusCode::SERVICE_UNAVAILABLE,
    };
    (code, Json(report.to_json())).into_response()
}

async fn metrics(State(shared): State<Shared>) -> Response {
    match metrics::render(&shared.reporter.report().await) {
        Ok(text) => ([(header::CONTENT_TYPE, metrics::CONTENT_TYPE)], text).into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    }
}

async fn devices(State(shared): State<Shared>) -> Response {
    Json(shared.reporter.report().await.devices_json(shared.clock.now())).into_response()
}

async fn buses(State(shared): State<Shared>) -> Response {
    Json(shared.reporter.report().await.buses_json()).into_response()
}
