//! Components in and out of the cell: upload, download, removal.
//!
//! ```text
//! bytes ──inspected, compiled──► one name and version, one component ──► disk ──► announced ──► copied by every host
//! ```

use std::sync::Arc;

use bumpless_core::{ComponentInfo, Digest, limits::TEXT_CHARS_MAX};
use tokio::time::timeout;

use crate::{
    bench::{engine_error, stopping},
    book::on_disk,
    error::Error,
    library::title,
    limits::UPLOAD_WAIT,
    room::{Room, count, unix_ms},
    wire::Notice,
};

impl Room {
    /// Takes a component in.
    pub(crate) async fn upload(
        self: &Arc<Self>,
        bytes: Vec<u8>,
        by: &str,
        note: &str,
    ) -> Result<Arc<ComponentInfo>, Error> {
        let end = self.take_in(bytes, by, note).await;
        count(if end.is_ok() {
            &self.tallies.uploads
        } else {
            &self.tallies.uploads_refused
        });
        end
    }

    async fn take_in(self: &Arc<Self>, bytes: Vec<u8>, by: &str, note: &str) -> Result<Arc<ComponentInfo>, Error> {
        for (what, text) in [("the uploader's name", by), ("the note", note)] {
            if text.chars().count() > TEXT_CHARS_MAX {
                return Err(Error::invalid(
                    format!("{what} is longer than {TEXT_CHARS_MAX} characters"),
                    "shorten it",
                ));
            }
        }
        let crowded = |_| {
            Error::busy(
                format!("other components are being uploaded at host {}", self.here),
                "try again",
            )
        };
        let _place = timeout(UPLOAD_WAIT, self.uploads.acquire())
            .await
            .map_err(crowded)?
            .map_err(|_| stopping())?;
        let bytes: Arc<[u8]> = bytes.into();
        let (engine, copy) = (self.bench.engine.clone(), Arc::clone(&bytes));
        let inspection = on_disk(move || engine.inspect(&copy))
            .await?
            .map_err(|error| engine_error(&error))?;
        let (name, version) = (
            inspection.descriptor.name.clone(),
            inspection.descriptor.version.clone(),
        );
        let _admission = self.admission.lock().await;
        // Later than its own removal, also where that was said by a host whose clock is ahead.
        let (_, removals) = self.library.heads();
        let removed_ms = removals
            .iter()
            .find(|(digest, _)| *digest == inspection.digest)
            .map_or(0, |(_, at_ms)| at_ms + 1);
        let info = ComponentInfo {
            digest: inspection.digest,
            name,
            version,
            descriptor: inspection.descriptor,
            imports: inspection.imports,
            bytes: inspection.bytes as u64,
            uploaded_at_unix_ms: unix_ms().max(removed_ms),
            uploaded_by: by.to_owned(),
            note: note.to_owned(),
        };
        if let Some(known) = self.library.admit(&info)? {
            return Ok(known);
        }
        info.check().map_err(|error| Error::invalid(error.to_string(), ""))?;
        let info = Arc::new(info);
        self.library.keep(Arc::clone(&info), Some(bytes)).await?;
        self.announce(&Notice::Component(info.digest));
        // Ready here at once, so that what is uploaded can be called. A full engine is told when it matters.
        if let Err(error) = self.prepared(info.digest, None).await {
            tracing::warn!(digest = %info.digest, %error, "an uploaded component is not ready here yet");
        }
        Ok(info)
    }

    /// Removes a component from the library of the cell.
    pub(crate) async fn remove_component(&self, reference: &str) -> Result<(), Error> {
        let _admission = self.admission.lock().await;
        let info = self.library.resolve(reference)?;
        let users = self.book.users_of(&info.digest);
        if !users.is_empty() {
            let names = users
                .iter()
                .take(8)
                .map(ToString::to_string)
                .collect::<Vec<_>>()
                .join(", ");
            return Err(Error::refused(
                format!("component {} is used by {} loops: {names}", title(&info), users.len()),
                "swap or delete them; a loop also keeps the component that it can go back to",
            ));
        }
        let at_ms = unix_ms().max(info.uploaded_at_unix_ms);
        self.component_gone(info.digest, at_ms).await?;
        self.announce(&Notice::ComponentGone(info.digest, at_ms));
        Ok(())
    }

    /// A component's bytes, from this host or another.
    pub(crate) async fn component_bytes(self: &Arc<Self>, digest: &Digest) -> Result<Vec<u8>, Error> {
        self.bytes_of(*digest, None).await
    }
}
