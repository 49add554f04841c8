//! What each route needs: one table beside the routes. A route that is not in it is refused, except where nobody is asked.
//!
//! | role | may |
//! |---|---|
//! | viewer | look |
//! | operator | setpoint, mode, output, points by hand, alarms, programs' start, pause and stop |
//! | engineer | loops, programs, components, signatures, parameters, forces, jobs, rollouts, trials, hosts |
//! | admin | accounts, tokens, the document of trust |
//!
//! Never: decides; `bumpless_access` does.

use axum::http::Method;
use bumpless_access::{Need, Reach, Role};

/// What a route needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Who {
    /// Anybody: the page's files, signing in, whether the host is alive.
    Anyone,
    /// Somebody with this.
    Needs(Need),
}

const fn needs(role: Role, reach: Reach) -> Who {
    Who::Needs(Need { role, reach })
}

const LOOK: Who = needs(Role::Viewer, Reach::Any);
const OPERATE: Who = needs(Role::Operator, Reach::Loop);
const OPERATE_CELL: Who = needs(Role::Operator, Reach::Cell);
const ENGINEER: Who = needs(Role::Engineer, Reach::Loop);
const ENGINEER_CELL: Who = needs(Role::Engineer, Reach::Cell);
/// Takes away what is a secret of the plant, or much of a host's time, and changes nothing.
const ENGINEER_LOOK: Who = needs(Role::Engineer, Reach::Any);
const ADMIN: Who = needs(Role::Admin, Reach::Cell);

/// Method, pattern of the address, need. `HEAD` needs what `GET` does.
#[rustfmt::skip]
const TABLE: &[(&str, &str, Who)] = &[
    ("GET", "/", Who::Anyone),
    ("GET", "/addresses", Who::Anyone),
    ("GET", "/assets/{name}", Who::Anyone),
    ("GET", "/icon.svg", Who::Anyone),
    ("GET", "/livez", Who::Anyone),
    ("GET", "/healthz", Who::Anyone),
    ("GET", "/readyz", Who::Anyone),
    ("GET", "/v1/access/me", Who::Anyone),
    ("POST", "/v1/access/first", Who::Anyone),
    ("POST", "/v1/access/sign-in", Who::Anyone),
    ("POST", "/v1/access/sign-out", LOOK),
    ("POST", "/v1/access/password", LOOK),
    ("GET", "/v1/access/users", ADMIN),
    ("POST", "/v1/access/users", ADMIN),
    ("PATCH", "/v1/access/users/{user}", ADMIN),
    ("DELETE", "/v1/access/users/{user}", ADMIN),
    ("POST", "/v1/access/users/{user}/tokens", ADMIN),
    ("GET", "/v1/access/tokens", ADMIN),
    ("POST", "/v1/access/tokens", LOOK),
    ("DELETE", "/v1/access/tokens/{id}", ADMIN),
    ("GET", "/v1/components", LOOK),
    ("POST", "/v1/components", ENGINEER_CELL),
    ("GET", "/v1/components/{reference}", LOOK),
    ("PATCH", "/v1/components/{reference}", ENGINEER_CELL),
    ("DELETE", "/v1/components/{reference}", ENGINEER_CELL),
    ("GET", "/v1/components/{reference}/bytes", ENGINEER_LOOK),
    ("GET", "/v1/components/{reference}/script", ENGINEER_LOOK),
    ("POST", "/v1/components/{reference}/call", ENGINEER_LOOK),
    ("GET", "/v1/signatures/{digest}", LOOK),
    ("POST", "/v1/signatures/{digest}", ENGINEER_CELL),
    ("GET", "/v1/trust", LOOK),
    ("PUT", "/v1/trust", ADMIN),
    ("GET", "/v1/bundle", ENGINEER_LOOK),
    ("POST", "/v1/bundle", ENGINEER_CELL),
    ("GET", "/v1/loops", LOOK),
    ("GET", "/v1/loops/{name}", LOOK),
    ("PUT", "/v1/loops/{name}", ENGINEER),
    ("DELETE", "/v1/loops/{name}", ENGINEER),
    ("POST", "/v1/loops/{name}/setpoint", OPERATE),
    ("POST", "/v1/loops/{name}/mode", OPERATE),
    ("POST", "/v1/loops/{name}/output", OPERATE),
    ("POST", "/v1/loops/{name}/set", ENGINEER),
    ("POST", "/v1/loops/{name}/swap", ENGINEER),
    ("POST", "/v1/loops/{name}/rollback", ENGINEER),
    ("POST", "/v1/loops/{name}/move", ENGINEER),
    ("GET", "/v1/loops/{name}/cycles", LOOK),
    ("GET", "/v1/loops/{name}/history", LOOK),
    ("GET", "/v1/points/{name}/history", LOOK),
    ("POST", "/v1/loops/{name}/replay", ENGINEER),
    ("POST", "/v1/loops/{name}/backtest", ENGINEER),
    ("GET", "/v1/loops/{name}/shadows", LOOK),
    ("POST", "/v1/loops/{name}/shadows", ENGINEER),
    ("GET", "/v1/loops/{name}/shadows/{id}", LOOK),
    ("DELETE", "/v1/loops/{name}/shadows/{id}", ENGINEER),
    ("GET", "/v1/programs", LOOK),
    ("POST", "/v1/programs", ENGINEER_CELL),
    ("GET", "/v1/programs/{name}", LOOK),
    ("DELETE", "/v1/programs/{name}", ENGINEER_CELL),
    ("POST", "/v1/programs/{name}/order", OPERATE_CELL),
    ("GET", "/v1/programs/{name}/log", LOOK),
    ("GET", "/v1/programs/{name}/checkpoint", ENGINEER_LOOK),
    ("GET", "/v1/rollouts", LOOK),
    ("POST", "/v1/rollouts", ENGINEER_CELL),
    ("GET", "/v1/rollouts/{id}", LOOK),
    ("POST", "/v1/rollouts/{id}/stop", ENGINEER_CELL),
    ("GET", "/v1/alarms", LOOK),
    ("GET", "/v1/alarms/history", LOOK),
    ("GET", "/v1/loops/{name}/alarms/{alarm}", LOOK),
    ("POST", "/v1/loops/{name}/alarms/{alarm}", OPERATE),
    ("PUT", "/v1/loops/{name}/alarms/{alarm}", ENGINEER),
    ("DELETE", "/v1/loops/{name}/alarms/{alarm}", ENGINEER),
    ("GET", "/v1/alarms/metrics", LOOK),
    ("GET", "/v1/webhooks", LOOK),
    ("GET", "/v1/audit", LOOK),
    ("GET", "/v1/audit/verify", LOOK),
    ("GET", "/v1/audit/export", ENGINEER_LOOK),
    ("GET", "/v1/hosts", LOOK),
    ("GET", "/v1/hosts/{name}/health", LOOK),
    ("POST", "/v1/hosts/{name}/drain", ENGINEER_CELL),
    ("POST", "/v1/hosts/{name}/undrain", ENGINEER_CELL),
    ("GET", "/v1/points", LOOK),
    ("GET", "/v1/points/{name}", LOOK),
    ("POST", "/v1/points/{name}/write", OPERATE_CELL),
    ("POST", "/v1/points/{name}/force", ENGINEER_CELL),
    ("POST", "/v1/points/{name}/unforce", ENGINEER_CELL),
    ("GET", "/v1/buses", LOOK),
    ("GET", "/v1/jobs", LOOK),
    ("POST", "/v1/jobs", ENGINEER_CELL),
    ("GET", "/v1/jobs/{id}", LOOK),
    ("POST", "/v1/jobs/{id}/cancel", ENGINEER_CELL),
    ("GET", "/v1/live", LOOK),
    ("GET", "/v1/loops/{name}/trend", LOOK),
    ("GET", "/v1/notices", LOOK),
    ("GET", "/v1/lab/reports", LOOK),
    ("GET", "/v1/lab/reports/{file}", LOOK),
    ("GET", "/v1/demo", LOOK),
    ("POST", "/v1/demo/faults", ENGINEER_CELL),
    ("GET", "/metrics", LOOK),
    ("GET", "/openapi.json", LOOK),
];

/// What a route needs; none for one that the table does not know.
pub(crate) fn of(method: &Method, path: &str) -> Option<Who> {
    let method = if *method == Method::HEAD {
        "GET"
    } else {
        method.as_str()
    };
    let row = TABLE.iter().find(|(m, p, _)| *m == method && *p == path);
    row.map(|(_, _, who)| *who)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_row_stands_once_and_changes_need_more_than_looking() {
        for (number, (method, path, who)) in TABLE.iter().enumerate() {
            assert!(
                !TABLE.iter().skip(number + 1).any(|(m, p, _)| (m, p) == (method, path)),
                "{method} {path}"
            );
            let Who::Needs(need) = who else { continue };
            let own = ["/v1/access/sign-out", "/v1/access/password", "/v1/access/tokens"].contains(path);
            assert!(
                *method == "GET" || own || need.role >= Role::Operator,
                "{method} {path}"
            );
            assert_eq!(
                need.reach == Reach::Loop,
                *method != "GET" && path.starts_with("/v1/loops/"),
                "{method} {path}"
            );
        }
    }
}
