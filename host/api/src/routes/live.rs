//! `/v1/live`: records as server-sent events, as they leave the arbiters.
//!
//! `form=rows` is the feed for pages: see `rows`. A feed never holds the cell up: whoever reads too slowly loses the oldest records and is told how many (`lost`).

mod rows;

use std::{
    collections::{HashMap, HashSet},
    convert::Infallible,
    sync::Arc,
    time::Duration,
};

use axum::{
    extract::State,
    http::{HeaderMap, HeaderName},
    response::{
        IntoResponse as _, Response,
        sse::{Event, KeepAlive, Sse},
    },
};
use bumpless_core::{LoopId, Record as CoreRecord};
use bumpless_deploy::{alarms::AlarmEvent, commissioning::FieldEvent};
use futures_util::stream;
use serde::Deserialize;
use tokio::{
    sync::{
        OwnedSemaphorePermit,
        broadcast::{self, error::RecvError},
        watch,
    },
    time::{Interval, MissedTickBehavior},
};
use utoipa::{IntoParams, ToSchema};

use crate::{
    error::{Kind, Problem},
    extract::InQuery,
    limits::{BEAT_MS_DEFAULT, BEAT_MS_MAX, BEAT_MS_MIN, FEED_LOOPS_MAX, HOSTS_EVERY, KEEP_ALIVE, TRACES_MAX},
    server::App,
    types::{AlarmHappening, FieldNews, Hosts, Record},
};

use rows::{Mark, Rows, Wanted};

/// What of the records.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct LiveQuery {
    /// Only these loops, names separated by commas, at most 64; all where not given.
    loops: Option<String>,
    /// At most one record per loop in this many ms, besides those with events; all where not given.
    every_ms: Option<u32>,
    /// With the controllers' states.
    #[serde(default)]
    state: bool,
    /// How the feed is told: `records` where not given.
    #[serde(default)]
    form: Form,
    /// With `form=rows`: every cycle of these loops, names separated by commas, at most 8.
    trace: Option<String>,
    /// With `form=rows`: the id of the last event that the reader has; the header `Last-Event-ID` does the same.
    after: Option<String>,
}

/// How a feed is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Form {
    /// Every record, whole.
    #[default]
    Records,
    /// The numbers of the newest cycle of each loop, a few times a second.
    Rows,
}

/// Follows the records. Events: `record` (a record), `hosts` (the hosts, every second, the first at once), `field` (what happened to a point
/// or a job, as FieldNews), `alarm` (what happened to an alarm of any loop of the cell, as AlarmHappening), `lost` (how many
/// records this reader was too slow for).
///
/// With `form=rows`, for pages that watch many loops: `rows` (LiveRows) every `every_ms` (50 to 10,000, else 200), `notices` (what
/// people should hear of), `alarms` (what happened to alarms, AlarmHappening), `hosts` every second, `loops` (where each loop
/// stands) when that changed, `field` (LiveField) when a point was forced, freed or written by hand, or a job moved. Every event
/// has an id; with `Last-Event-ID` a reader gets the notices, the happenings of alarms and the traced cycles that it missed. A
/// slow reader gets the newest of each loop.
#[utoipa::path(get, operation_id = "follow_records", path = "/v1/live", tag = "cell", params(LiveQuery),
    responses(
        (status = 200, description = "Server-sent events: `record` with a Record, `hosts` with Hosts, `field` with FieldNews, `alarm` with AlarmHappening, `lost` with {\"records\": n}; in rows: `rows`, `notices`, `alarms`, `hosts`, `loops`, `field` with LiveField",
            body = Record, content_type = "text/event-stream"),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn feed(
    State(app): State<App>,
    InQuery(query): InQuery<LiveQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let loops = query.loops.as_deref().map(loop_names).transpose()?;
    let place = Arc::clone(&app.feeds).try_acquire_owned().map_err(|_| {
        Problem::new(
            Kind::Busy,
            "too many live feeds are open",
            "close one, or ask another host of the cell",
        )
    })?;
    // Proxies such as nginx hold back what they do not know to be a feed.
    let unbuffered = [(HeaderName::from_static("x-accel-buffering"), "no")];
    if query.form == Form::Rows {
        let wanted = wanted_rows(&query, loops, &headers)?;
        let rows = Rows::open(app, wanted, place).await;
        let events = stream::unfold(rows, async |mut rows| {
            rows.next().await.map(|event| (Ok::<_, Infallible>(event), rows))
        });
        let sse = Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE));
        return Ok((unbuffered, sse).into_response());
    }
    let mut hosts = tokio::time::interval(HOSTS_EVERY);
    hosts.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let feed = Feed {
        records: app.cell.records(),
        news: app.cell.field_events(),
        alarms: app.cell.alarm_events(),
        stop: app.stop.clone(),
        hosts,
        filter: Filter {
            loops,
            every_ns: u64::from(query.every_ms.unwrap_or(0)) * 1_000_000,
            sent: HashMap::new(),
        },
        with_state: query.state,
        app,
        _place: place,
    };
    let events = stream::unfold(feed, async |mut feed| {
        feed.next().await.map(|event| (Ok::<_, Infallible>(event), feed))
    });
    let sse = Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE));
    Ok((unbuffered, sse).into_response())
}

/// What a feed in rows shall carry.
fn wanted_rows(query: &LiveQuery, loops: Option<HashSet<LoopId>>, headers: &HeaderMap) -> Result<Wanted, Problem> {
    let traced = query.trace.as_deref().map(loop_names).transpose()?.unwrap_or_default();
    if traced.len() > TRACES_MAX {
        let detail = format!("trace names {} loops", traced.len());
        return Err(Problem::new(
            Kind::Invalid,
            detail,
            format!("name at most {TRACES_MAX}"),
        ));
    }
    let every_ms = query
        .every_ms
        .unwrap_or(BEAT_MS_DEFAULT)
        .clamp(BEAT_MS_MIN, BEAT_MS_MAX);
    // A browser that reconnects by itself sends the header; it is the newer one.
    let header = headers.get("last-event-id").and_then(|value| value.to_str().ok());
    let after = header.or(query.after.as_deref()).filter(|text| !text.is_empty());
    let after = after
        .map(|text| {
            Mark::parse(text).ok_or_else(|| {
                let text: String = text.chars().take(80).collect();
                let detail = format!("{text:?} is no id of an event of this feed");
                Problem::new(Kind::Invalid, detail, "leave it out to begin anew")
            })
        })
        .transpose()?;
    Ok(Wanted {
        loops,
        traced,
        every: Duration::from_millis(u64::from(every_ms)),
        after,
    })
}

/// Names from the query.
fn loop_names(text: &str) -> Result<HashSet<LoopId>, Problem> {
    let names: HashSet<LoopId> = text
        .split(',')
        .map(str::trim)
        .filter(|name| !name.is_empty())
        .map(LoopId::new)
        .collect::<Result<_, _>>()?;
    if names.is_empty() || names.len() > FEED_LOOPS_MAX {
        let detail = format!("loops names {} loops", names.len());
        return Err(Problem::new(
            Kind::Invalid,
            detail,
            format!("name 1 to {FEED_LOOPS_MAX}, or leave it out for all"),
        ));
    }
    Ok(names)
}

/// Which records pass.
struct Filter {
    loops: Option<HashSet<LoopId>>,
    every_ns: u64,
    /// When a record of each loop was last passed on; only kept where records are thinned out.
    sent: HashMap<LoopId, u64>,
}

impl Filter {
    /// Is the loop among those that were asked for?
    fn is_of(&self, id: &LoopId) -> bool {
        self.loops.as_ref().is_none_or(|loops| loops.contains(id))
    }

    fn passes(&mut self, record: &CoreRecord) -> bool {
        if !self.is_of(&record.loop_id) {
            return false;
        }
        if self.every_ns == 0 {
            return true;
        }
        let due = self
            .sent
            .get(&record.loop_id)
            .is_none_or(|&at| record.at_ns >= at.saturating_add(self.every_ns));
        if due {
            self.sent.insert(record.loop_id.clone(), record.at_ns);
        }
        // What people should hear of is never thinned out.
        due || !record.events.is_empty() || !record.alarms.is_empty()
    }
}

/// One reader.
struct Feed {
    app: App,
    records: broadcast::Receiver<Arc<CoreRecord>>,
    news: broadcast::Receiver<FieldEvent>,
    alarms: broadcast::Receiver<Arc<AlarmEvent>>,
    hosts: Interval,
    stop: watch::Receiver<bool>,
    filter: Filter,
    with_state: bool,
    _place: OwnedSemaphorePermit,
}

impl Feed {
    /// The next event; none when the host stops.
    async fn next(&mut self) -> Option<Event> {
        loop {
            let event = tokio::select! {
                biased;
                _ = self.stop.wait_for(|stop| *stop) => return None,
                _ = self.hosts.tick() => {
                    let hosts = Hosts { hosts: self.app.cell.hosts().into_iter().map(Into::into).collect(), next: None };
                    Event::default().event("hosts").json_data(hosts)
                }
                news = self.news.recv() => match news {
                    Ok(news) => Event::default().event("field").json_data(FieldNews::from(news)),
                    Err(RecvError::Lagged(lost)) => {
                        Event::default().event("lost").json_data(serde_json::json!({ "records": 0, "field": lost }))
                    }
                    Err(RecvError::Closed) => return None,
                },
                event = self.alarms.recv() => match event {
                    Ok(event) if self.filter.is_of(&event.loop_id) => {
                        Event::default().event("alarm").json_data(AlarmHappening::from(&*event))
                    }
                    Ok(_) => continue,
                    Err(RecvError::Lagged(lost)) => {
                        Event::default().event("lost").json_data(serde_json::json!({ "records": 0, "alarms": lost }))
                    }
                    Err(RecvError::Closed) => return None,
                },
                next = self.records.recv() => match next {
                    Ok(record) if self.filter.passes(&record) => {
                        let ports = self.app.ports(&record.digest);
                        Event::default().event("record").json_data(Record::new(&record, &ports, self.with_state))
                    }
                    Ok(_) => continue,
                    Err(RecvError::Lagged(lost)) => {
                        Event::default().event("lost").json_data(serde_json::json!({ "records": lost }))
                    }
                    Err(RecvError::Closed) => return None,
                },
            };
            match event {
                Ok(event) => return Some(event),
                // Plain data always serialises; if it ever does not, the feed goes on without it.
                Err(error) => tracing::warn!(%error, "an event of the live feed could not be written"),
            }
        }
    }
}
