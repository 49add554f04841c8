//! How values leave: in batches, in order, and looked at again where that is wanted.
//!
//! ```text
//! waiting ─► sent ─► confirmed ──verify──► read back ─► held, or an error and unknown
//!              ├─ refused: an error, and unknown
//!              └─ no answer: waiting again, until it is too old
//! ```

use super::{
    super::{
        WriteWith,
        batch::{Batch, Content, batches},
    },
    Answer, Connection, End, Exception, Failure, Instant, Link, NoData, Quality, Request,
};

impl Link {
    /// Sends all that waits, neighbours together.
    pub(super) async fn send_writes(&mut self, connection: &mut Connection) -> Result<(), End> {
        let (wishes, expired) = self.shared.outbox.take(self.lane, self.shared.clock.now_ns());
        if expired > 0 {
            self.report(&format!(
                "{expired} values waited too long for the device and were given up"
            ));
        }
        let mut batches = batches(&self.shared.plan.points, wishes, self.shared.plan.write_with).into_iter();
        while let Some(batch) = batches.next() {
            // A unit that is quiet keeps its wishes until it is asked again, or they expire.
            if self.quiet.get(&batch.unit_id).is_some_and(|q| q.until > Instant::now()) {
                batch.wishes.iter().for_each(|wish| self.shared.outbox.put_back(wish));
                continue;
            }
            match self.write(connection, &batch).await {
                Ok(back) => self.written(&batch, back),
                Err(Failure::Exception(exception)) => {
                    self.answered(batch.unit_id);
                    self.refused += 1;
                    self.report(&format!("write to {}: {exception}", self.place(&batch)));
                    let now_ns = self.shared.clock.now_ns();
                    for wish in &batch.wishes {
                        self.shared
                            .image
                            .set(wish.point, Err(NoData::DeviceError(exception.0)), Quality::Bad, now_ns);
                    }
                }
                Err(failure @ Failure::Fenced) => {
                    // Whoever is master has its own wishes; these would be old when this host is it again.
                    self.refused += 1;
                    let place = format!("write to {}", self.place(&batch));
                    self.failed(connection, batch.unit_id, &place, failure)?;
                }
                Err(failure) => {
                    batch.wishes.iter().for_each(|wish| self.shared.outbox.put_back(wish));
                    let place = format!("write to {}", self.place(&batch));
                    if let Err(end) = self.failed(connection, batch.unit_id, &place, failure) {
                        // What is behind it waits for the next connection.
                        for wish in batches.flat_map(|batch| batch.wishes) {
                            self.shared.outbox.put_back(&wish);
                        }
                        return Err(end);
                    }
                }
            }
        }
        Ok(())
    }

    /// Writes a batch; gives what the device holds where that was looked at.
    async fn write(&mut self, connection: &mut Connection, batch: &Batch) -> Result<Option<Vec<u16>>, Failure> {
        let masked = matches!(batch.content, Content::Mask { .. });
        let answer = if masked && self.without_mask.contains(&batch.unit_id) {
            Err(Failure::Exception(Exception::FUNCTION))
        } else {
            let request = batch.request(self.shared.plan.write_with);
            self.request(connection, batch.unit_id, &request).await
        };
        match answer {
            Ok(Answer::Words(words)) => return Ok(Some(words)),
            Ok(_) => {}
            Err(Failure::Exception(Exception::FUNCTION)) if masked => self.write_bits(connection, batch).await?,
            Err(failure) => return Err(failure),
        }
        if !self.shared.plan.verify {
            return Ok(None);
        }
        match self.request(connection, batch.unit_id, &batch.read_back()).await? {
            Answer::Words(words) => Ok(Some(words)),
            Answer::Bits(bits) => Ok(Some(bits.into_iter().map(u16::from).collect())),
            Answer::Done | Answer::Identity { .. } => Ok(None),
        }
    }

    /// For a device without function 22: reads the register, and writes it with other bits. In between it may change; the
    /// log says so once.
    async fn write_bits(&mut self, connection: &mut Connection, batch: &Batch) -> Result<(), Failure> {
        if self.without_mask.insert(batch.unit_id) {
            tracing::warn!(
                bus = %self.shared.plan.bus,
                "unit {} has no function 22: bits are written by reading their register and writing it whole",
                batch.unit_id
            );
        }
        let Answer::Words(words) = self.request(connection, batch.unit_id, &batch.read_back()).await? else {
            return Ok(());
        };
        if let (Content::Mask { and, or }, [word]) = (&batch.content, words.as_slice()) {
            let whole = Batch {
                content: Content::Registers(vec![(word & and) | (or & !and)]),
                ..batch.clone()
            };
            let with = match self.shared.plan.write_with {
                WriteWith::ReadWrite => WriteWith::Auto,
                with => with,
            };
            let request: Request = whole.request(with);
            self.request(connection, batch.unit_id, &request).await?;
        }
        Ok(())
    }

    /// The device confirmed, and perhaps said what it holds now.
    fn written(&mut self, batch: &Batch, back: Option<Vec<u16>>) {
        let now_ns = self.shared.clock.now_ns();
        self.answered(batch.unit_id);
        let held = back.as_deref().is_none_or(|words| batch.is_held(words));
        if held {
            for wish in &batch.wishes {
                self.shared.outbox.sent(wish, now_ns);
                self.show(wish.point, wish.words.as_slice(), now_ns);
            }
            self.shared.status.update(|s| s.writes += batch.wishes.len() as u64);
            return;
        }
        // The next poll shows what it holds; the next write of the loop is sent whatever its value.
        self.report(&format!(
            "write to {}: the device holds {:?} after it confirmed {:?}",
            self.place(batch),
            back.unwrap_or_default(),
            batch.content
        ));
    }

    fn place(&self, batch: &Batch) -> String {
        let point = batch
            .wishes
            .first()
            .and_then(|wish| self.shared.plan.points.get(wish.point));
        format!(
            "point {}, unit {}, {} {}",
            point.map_or("", |p| p.id.as_str()),
            batch.unit_id,
            batch.table().name(),
            batch.start
        )
    }
}
