//! Jobs for programs on the bus: what `/v1/jobs` does, over Zenoh, in the same JSON.
//!
//! ```text
//! get bumpless/<cell>/open/jobs/<any host>      {"start": JobRequest} | {"show": id} | {"cancel": {"id": id, "by": who}}
//!   └► one reply: the first of two              {"ack": Job} | {"nack": Problem}
//! put bumpless/<cell>/open/jobs/<host of the job>/<number>     Job, at each change; the one that has ended is the second
//! ```
//!
//! Who listens at `bumpless/<cell>/open/jobs/**` before it asks misses nothing; who does not, asks with `show`.
//!
//! Never: decides anything; the routes and these words call the same functions.

use std::sync::Arc;

use bumpless_deploy::{
    Deploy, Knock,
    commissioning::{FieldEvent, JobView},
};
use serde::{Deserialize, Serialize};
use tokio::{runtime::Handle, sync::broadcast};

use crate::{
    error::{Kind, Problem},
    field::Field,
    types::{Job, JobRequest},
};

/// The name of the door.
const JOBS: &str = "jobs";

/// What may be asked.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
enum Question {
    /// Take a job in.
    Start(Box<JobRequest>),
    /// One job with its result so far.
    Show(String),
    /// End one.
    Cancel {
        /// The job.
        id: String,
        /// Who asks.
        by: String,
    },
}

/// What is answered at once.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
enum Word {
    /// It was taken in, or was before with this key; it is so; it ends.
    Ack(Box<Job>),
    /// It was not, and why.
    Nack(Problem),
}

/// Opens the door of this host. Ends with the host's place on the bus.
pub(crate) fn open(deploy: &Deploy) {
    let runtime = match Handle::try_current() {
        Ok(runtime) => runtime,
        Err(error) => {
            tracing::warn!(%error, "jobs cannot be asked for over the bus");
            return;
        }
    };
    let field: Arc<dyn Field> = Arc::new(deploy.clone());
    let (asked, tasks) = (Arc::clone(&field), runtime.clone());
    let answers = move |knock: Knock| {
        let field = Arc::clone(&asked);
        // As many at a time as the door lets in.
        tasks.spawn(async move {
            let word = answer(field.as_ref(), &knock.payload).await;
            knock.answer(json(&word));
        });
    };
    if let Err(error) = deploy.open_door(JOBS, answers) {
        tracing::warn!(%error, "jobs cannot be asked for over the bus");
        return;
    }
    let (deploy, events) = (deploy.clone(), deploy.field_events());
    runtime.spawn(tell(deploy, field, events));
}

/// Tells what becomes of the jobs of this host.
async fn tell(deploy: Deploy, field: Arc<dyn Field>, mut events: broadcast::Receiver<FieldEvent>) {
    loop {
        let view = match events.recv().await {
            Ok(FieldEvent::Job(view)) if view.host == *deploy.here() => view,
            // A listener that misses a change asks for the job.
            Ok(_) | Err(broadcast::error::RecvError::Lagged(_)) => continue,
            Err(broadcast::error::RecvError::Closed) => return,
        };
        let number = view.id.rsplit('.').next().unwrap_or_default().to_owned();
        let job = with_result(field.as_ref(), view).await;
        deploy.publish_at_door(JOBS, &number, json(&job));
    }
}

/// An event comes without the result; a job that has ended goes out with it.
async fn with_result(field: &dyn Field, view: JobView) -> Job {
    if !view.state.ended() {
        return view.into();
    }
    match field.job(view.id.clone()).await {
        Ok(whole) => whole.into(),
        Err(_) => view.into(),
    }
}

async fn answer(field: &dyn Field, payload: &[u8]) -> Word {
    let question: Question = match serde_json::from_slice(payload) {
        Ok(question) => question,
        Err(error) => {
            return Word::Nack(Problem::new(
                Kind::BadRequest,
                format!("the question cannot be read: {error}"),
                "ask {\"start\": {…}} as for POST /v1/jobs, {\"show\": id}, or {\"cancel\": {\"id\": id, \"by\": who}}",
            ));
        }
    };
    let end = match question {
        Question::Start(request) => match (*request).try_into() {
            Ok(draft) => field.start_job(draft).await.map_err(Problem::from),
            Err(error) => Err(Problem::from(error)),
        },
        Question::Show(id) => field.job(id).await.map_err(Problem::from),
        Question::Cancel { id, by } => field.cancel_job(id, by).await.map_err(Problem::from),
    };
    match end {
        Ok(view) => Word::Ack(Box::new(view.into())),
        Err(problem) => Word::Nack(problem),
    }
}

/// Strings, numbers and lists of them always serialise; an empty answer would still be one.
fn json<T: Serialize>(value: &T) -> Vec<u8> {
    serde_json::to_vec(value).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use serde_json::{Value, json as value};

    use super::*;
    use crate::tests::fake::Fake;

    #[tokio::test]
    async fn each_question_has_one_word() {
        let device = Fake::new();
        for (question, part, wanted) in [
            (
                value!({"start": {"bus": "line", "name": "set-range", "by": "scada"}}),
                "/ack/state",
                value!("queued"),
            ),
            (value!({"show": "plant.1"}), "/ack/id", value!("h.1000001")),
            (
                value!({"cancel": {"id": "plant.1", "by": "scada"}}),
                "/ack/state",
                value!("cancelled"),
            ),
            (
                value!({"start": {"bus": "line", "by": "scada"}}),
                "/nack/type",
                value!("urn:bumpless:problem:invalid"),
            ),
            (
                value!({"begin": 1}),
                "/nack/type",
                value!("urn:bumpless:problem:bad-request"),
            ),
            (value!([]), "/nack/type", value!("urn:bumpless:problem:bad-request")),
        ] {
            let word = answer(&device, question.to_string().as_bytes()).await;
            let said: Value = serde_json::from_slice(&json(&word)).unwrap();
            assert_eq!(said.pointer(part), Some(&wanted), "{question}: {said}");
            assert_eq!(said.as_object().unwrap().len(), 1, "{said}");
        }
        let word = answer(&device, b"\xff").await;
        assert!(matches!(word, Word::Nack(_)));
    }
}
