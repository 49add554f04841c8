//! The cell's API over HTTP: REST, a live feed, metrics, and the one map from errors to answers.
//!
//! Owns: routes, what travels over them, their limits, and the OpenAPI document. It is the only room that names axum.
//! Never: decides about a loop or a component, touches disk or bus, or lets a request wait without end. What a
//! route needs stands in `needs`; `guard` asks for it before a body is read. A host on loopback may ask nobody.
//!
//! ```text
//! connection (CONNECTIONS_MAX) ─► head (HEAD_TIME_MAX) ─► guard ─► request (REQUESTS_MAX) ─► time limit ─► extract ─► Cell (deploy) ─► types ─► JSON
//!             └ full: waits                  └ full: 503       └ over: 504  └ bad: 4xx  └ error: the map in `error`
//! ```
//! A change that has begun is finished even when its asker leaves (`once`: and done once, however often it is asked for).
//!
//! What all routes share is `extract`, `paging`, `tag` and `once`; a new route gets limits, keys and documented errors by itself.
//!
//! Reading order: `types`, `routes`, `server`; `error` has the map.

pub mod limits;
pub mod types;

mod access;
mod asker;
mod cell;
mod door;
mod error;
mod export;
mod extract;
mod field;
mod gate;
mod guard;
mod happenings;
mod metrics;
mod needs;
mod notices;
mod once;
mod openapi;
mod paging;
mod program;
#[allow(
    unused_qualifications,
    reason = "utoipa writes `super::` before the query types of the routes"
)]
mod routes;
mod server;
mod signing;
mod tag;
mod tls;
mod trail;

#[cfg(test)]
mod tests;

pub use error::{Error, Problem};
pub use metrics::Metrics;
pub use openapi::openapi_json;
pub use server::{Options, serve};
pub use tls::TlsFiles;
