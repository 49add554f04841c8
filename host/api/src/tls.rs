//! TLS of the API: certificate and key from files, read again when they change.
//!
//! ```text
//! files ── good ──► in force ── changed, good ──► the new ones, for new connections
//!              └ bad at the start: the host does not start      └ bad later: the old ones stay, and the log says why
//! ```
//! Never: writes a file; offers less than TLS 1.2; asks a caller for a certificate (accounts and tokens say who he is).

use std::{
    fs, io,
    path::{Path, PathBuf},
    sync::{Arc, PoisonError, RwLock},
    time::SystemTime,
};

use tokio_rustls::{
    TlsAcceptor,
    rustls::{
        ServerConfig,
        crypto::ring,
        pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject as _},
    },
};

use crate::{error::Error, limits::TLS_LOOK_EVERY};

/// Bytes of a file with certificates or a key: a chain of ten is a tenth of it.
const FILE_BYTES_MAX: u64 = 256 * 1024;

/// Where certificate and key of the API are, as PEM.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TlsFiles {
    /// The host's certificate, then those that signed it.
    pub certificate: PathBuf,
    /// Its private key.
    pub key: PathBuf,
}

/// What tells whether a file was written.
type Stamp = Option<(SystemTime, u64)>;

impl TlsFiles {
    /// Reads both, and checks that they belong together.
    ///
    /// # Errors
    /// [`Error::Tls`] names the file and what is wrong with it.
    pub fn read(&self) -> Result<Arc<ServerConfig>, Error> {
        let wrong = |path: &Path, reason: String| Error::Tls {
            path: path.to_owned(),
            reason,
        };
        for path in [&self.certificate, &self.key] {
            let about = fs::metadata(path).map_err(|error| wrong(path, error.to_string()))?;
            if about.len() > FILE_BYTES_MAX {
                return Err(wrong(path, format!("it has more than {FILE_BYTES_MAX} bytes")));
            }
        }
        let chain: Result<Vec<_>, _> = CertificateDer::pem_file_iter(&self.certificate)
            .map_err(|error| wrong(&self.certificate, error.to_string()))?
            .collect();
        let chain = chain.map_err(|error| wrong(&self.certificate, error.to_string()))?;
        if chain.is_empty() {
            return Err(wrong(&self.certificate, "there is no certificate in it".to_owned()));
        }
        let key = PrivateKeyDer::from_pem_file(&self.key).map_err(|error| wrong(&self.key, error.to_string()))?;
        let mut config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()
            .map_err(|error| wrong(&self.certificate, error.to_string()))?
            .with_no_client_auth()
            .with_single_cert(chain, key)
            .map_err(|error| wrong(&self.certificate, format!("with this key: {error}")))?;
        config.alpn_protocols = vec![b"http/1.1".to_vec()];
        Ok(Arc::new(config))
    }

    fn stamps(&self) -> [Stamp; 2] {
        [&self.certificate, &self.key].map(|path| {
            let about: io::Result<_> = fs::metadata(path);
            about.and_then(|about| Ok((about.modified()?, about.len()))).ok()
        })
    }
}

/// What is in force. Clones share it.
#[derive(Clone)]
pub(crate) struct Tls(Arc<RwLock<Arc<ServerConfig>>>);

impl Tls {
    /// Reads the files, and looks at them from now on, until the last clone is gone.
    pub(crate) async fn start(files: TlsFiles) -> Result<Self, Error> {
        let stamps = files.stamps();
        let first = files.clone();
        let config = blocking(move || first.read()).await??;
        let tls = Self(Arc::new(RwLock::new(config)));
        let weak = Arc::downgrade(&tls.0);
        tokio::spawn(async move {
            let mut seen = stamps;
            loop {
                tokio::time::sleep(TLS_LOOK_EVERY).await;
                let Some(in_force) = weak.upgrade() else { return };
                let looked = files.clone();
                let now = match blocking(move || looked.stamps()).await {
                    Ok(now) if now != seen => now,
                    _ => continue,
                };
                let looked = files.clone();
                // Written in two steps, they do not fit in between; the next look finds what does.
                match blocking(move || looked.read()).await.and_then(|read| read) {
                    Ok(config) => {
                        *in_force.write().unwrap_or_else(PoisonError::into_inner) = config;
                        tracing::info!(certificate = %files.certificate.display(), "the API goes on with another certificate");
                    }
                    Err(error) => tracing::error!(%error, "the API's certificate stays as it was"),
                }
                seen = now;
            }
        });
        Ok(tls)
    }

    /// For one connection.
    pub(crate) fn acceptor(&self) -> TlsAcceptor {
        TlsAcceptor::from(Arc::clone(&self.0.read().unwrap_or_else(PoisonError::into_inner)))
    }
}

async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, Error> {
    tokio::task::spawn_blocking(work)
        .await
        .map_err(|error| Error::Listener(io::Error::other(error)))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use super::*;

    #[test]
    fn what_is_no_certificate_or_key_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let files = TlsFiles {
            certificate: folder.path().join("a.pem"),
            key: folder.path().join("a.key"),
        };
        let error = |part: &str| {
            let text = files.read().map(drop).expect_err(part).to_string();
            assert!(text.contains(part), "{part}: {text}");
        };
        error("a.pem");
        fs::write(&files.certificate, "nothing").unwrap();
        error("a.key");
        fs::write(&files.key, "nothing").unwrap();
        error("no certificate");
        fs::write(&files.certificate, "x".repeat(300_000)).unwrap();
        error("more than");
    }
}
