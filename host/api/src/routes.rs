//! The routes by subject. Each handler reads, asks the cell once, and shapes the answer.
//!
//! Never: decides; what may be done is the cell's to say.

pub(crate) mod access;
pub(crate) mod alarms;
pub(crate) mod audit;
pub(crate) mod bundle;
pub(crate) mod components;
pub(crate) mod demo;
pub(crate) mod field;
pub(crate) mod health;
pub(crate) mod history;
pub(crate) mod hosts;
pub(crate) mod lab;
pub(crate) mod live;
pub(crate) mod load;
pub(crate) mod loops;
pub(crate) mod page;
pub(crate) mod pages;
pub(crate) mod past;
pub(crate) mod programs;
pub(crate) mod rollouts;
pub(crate) mod signing;
pub(crate) mod trend;

use axum::{
    Router,
    routing::{delete, get, patch, post},
};

use crate::server::App;

/// Everything that takes a place and has a time limit.
pub(crate) fn all() -> Router<App> {
    Router::new()
        .route("/v1/access/me", get(access::me))
        .route("/v1/access/first", post(access::first))
        .route("/v1/access/sign-in", post(access::sign_in))
        .route("/v1/access/sign-out", post(access::sign_out))
        .route("/v1/access/password", post(access::password))
        .route("/v1/access/users", get(access::users).post(access::add_user))
        .route(
            "/v1/access/users/{user}",
            patch(access::change_user).delete(access::remove_user),
        )
        .route("/v1/access/users/{user}/tokens", post(access::make_token))
        .route("/v1/access/tokens", get(access::tokens).post(access::make_own_token))
        .route("/v1/access/tokens/{id}", delete(access::revoke_token))
        .route("/v1/components", get(components::list).post(components::upload))
        .route(
            "/v1/components/{reference}",
            get(components::show)
                .patch(components::relabel)
                .delete(components::remove),
        )
        .route("/v1/bundle", get(bundle::export).post(bundle::import))
        .route("/v1/components/{reference}/bytes", get(components::bytes))
        .route("/v1/components/{reference}/script", get(programs::script))
        .route("/v1/components/{reference}/call", post(components::call))
        .route("/v1/trust", get(signing::show).put(signing::put))
        .route(
            "/v1/signatures/{digest}",
            get(signing::of_component).post(signing::sign),
        )
        .route("/v1/loops", get(loops::list))
        .route(
            "/v1/loops/{name}",
            get(loops::show).put(loops::apply).delete(loops::remove),
        )
        .route("/v1/loops/{name}/setpoint", post(loops::setpoint))
        .route("/v1/loops/{name}/mode", post(loops::mode))
        .route("/v1/loops/{name}/output", post(loops::output))
        .route("/v1/loops/{name}/set", post(loops::set))
        .route("/v1/loops/{name}/swap", post(loops::swap))
        .route("/v1/loops/{name}/rollback", post(loops::rollback))
        .route("/v1/loops/{name}/move", post(loops::move_owner))
        .route("/v1/loops/{name}/cycles", get(history::cycles))
        .route("/v1/loops/{name}/history", get(past::of_loop))
        .route("/v1/points/{name}/history", get(past::of_point))
        .route("/v1/loops/{name}/replay", post(history::replay))
        .route("/v1/loops/{name}/backtest", post(history::backtest))
        .route(
            "/v1/loops/{name}/shadows",
            get(history::shadows).post(history::start_shadow),
        )
        .route(
            "/v1/loops/{name}/shadows/{id}",
            get(history::show_shadow).delete(history::stop_shadow),
        )
        .route("/v1/rollouts", get(rollouts::list).post(rollouts::start))
        .route("/v1/rollouts/{id}", get(rollouts::show))
        .route("/v1/rollouts/{id}/stop", post(rollouts::stop))
        .route("/v1/programs", get(programs::list).post(programs::create))
        .route("/v1/programs/{name}", get(programs::show).delete(programs::remove))
        .route("/v1/programs/{name}/order", post(programs::order))
        .route("/v1/programs/{name}/log", get(programs::log))
        .route("/v1/programs/{name}/checkpoint", get(programs::checkpoint))
        .route("/v1/alarms", get(alarms::list))
        .route("/v1/alarms/history", get(alarms::past))
        .route(
            "/v1/loops/{name}/alarms/{alarm}",
            get(alarms::show)
                .post(alarms::act)
                .put(alarms::define)
                .delete(alarms::remove),
        )
        .route("/v1/alarms/metrics", get(load::metrics))
        .route("/v1/webhooks", get(load::webhooks))
        .route("/v1/audit", get(audit::list))
        .route("/v1/audit/verify", get(audit::verify))
        .route("/v1/audit/export", get(audit::export))
        .route("/v1/hosts", get(hosts::list))
        .route("/v1/hosts/{name}/health", get(health::of_host))
        .route("/v1/hosts/{name}/drain", post(hosts::drain))
        .route("/v1/hosts/{name}/undrain", post(hosts::undrain))
        .route("/v1/points", get(hosts::points))
        .route("/v1/points/{name}", get(field::point))
        .route("/v1/points/{name}/write", post(field::write))
        .route("/v1/points/{name}/force", post(field::force))
        .route("/v1/points/{name}/unforce", post(field::unforce))
        .route("/v1/buses", get(field::buses))
        .route("/v1/jobs", get(field::jobs).post(field::start))
        .route("/v1/jobs/{id}", get(field::job))
        .route("/v1/jobs/{id}/cancel", post(field::cancel))
        .route("/v1/live", get(live::feed))
        .route("/v1/loops/{name}/trend", get(trend::trend))
        .route("/v1/notices", get(trend::list_notices))
        .route("/v1/lab/reports", get(lab::list))
        .route("/v1/lab/reports/{file}", get(lab::show))
        .route("/v1/demo", get(demo::show))
        .route("/v1/demo/faults", post(demo::fault))
        .route("/metrics", get(pages::metrics))
        .route("/openapi.json", get(pages::openapi))
        .route("/", get(page::index))
        .merge(page::files())
}

/// Is the host alive, is it ready?
pub(crate) fn health() -> Router<App> {
    Router::new()
        .route("/livez", get(health::livez))
        .route("/healthz", get(health::livez))
        .route("/readyz", get(health::readyz))
}
