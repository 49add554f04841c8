//! TLS for Modbus both ways (Modbus/TCP Security): files become settings, and a wrong file is named with its cure.
//!
//! Never: goes on without checking the other side. There is no switch for that.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use serde::{Deserialize, Serialize};
use tokio_rustls::{
    TlsAcceptor, TlsConnector,
    rustls::{
        ClientConfig, RootCertStore, ServerConfig,
        crypto::{CryptoProvider, ring},
        pki_types::{CertificateDer, PrivateKeyDer, ServerName, pem::PemObject as _},
        server::WebPkiClientVerifier,
    },
};

use crate::Error;

/// Bytes of a file with certificates or a key: chains of dozens fit.
const FILE_BYTES_MAX: u64 = 1024 * 1024;

/// How a client is sure of its device, and the device of its client. All files are PEM.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClientTls {
    /// Certificates of the authorities that the device's certificate may come from.
    pub ca: PathBuf,
    /// This host's certificate, with what leads from it to its authority. Modbus/TCP Security asks for one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub certificate: Option<PathBuf>,
    /// The key of the certificate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub key: Option<PathBuf>,
    /// The name in the device's certificate, if it is not the host in the address.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub server_name: Option<String>,
}

/// How a server shows who it is, and whom it lets in. All files are PEM.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServerTls {
    /// The server's certificate, with what leads from it to its authority.
    pub certificate: PathBuf,
    /// The key of the certificate.
    pub key: PathBuf,
    /// Certificates of the authorities that clients' certificates must come from.
    pub client_ca: PathBuf,
}

impl ClientTls {
    /// Lets paths count from a folder.
    pub fn resolve(&mut self, folder: &Path) {
        for path in [Some(&mut self.ca), self.certificate.as_mut(), self.key.as_mut()] {
            resolve(path, folder);
        }
    }

    /// Reads the files. `host` is the name in the certificate unless another is set.
    ///
    /// # Errors
    /// `Error::Config` names the file.
    pub(crate) fn open(&self, place: &str, host: &str) -> Result<Tls, Error> {
        let builder = ClientConfig::builder_with_provider(provider())
            .with_safe_default_protocol_versions()
            .map_err(|error| Error::config(place, format!("TLS cannot be used: {error}")))?
            .with_root_certificates(authorities(place, "tls.ca", &self.ca)?);
        let config = match (&self.certificate, &self.key) {
            (Some(certificate), Some(key)) => builder
                .with_client_auth_cert(
                    chain(place, "tls.certificate", certificate)?,
                    private(place, "tls.key", key)?,
                )
                .map_err(|error| mismatch(place, key, certificate, &error))?,
            (None, None) => builder.with_no_client_auth(),
            _ => {
                return Err(Error::config(
                    place,
                    "tls.certificate and tls.key belong together; give both or none",
                ));
            }
        };
        let name = self.server_name.as_deref().unwrap_or(host);
        let name = ServerName::try_from(name.to_owned()).map_err(|_| {
            Error::config(
                place,
                format!("{name:?} cannot be the name in a certificate; set tls.server_name"),
            )
        })?;
        Ok(Tls {
            connector: TlsConnector::from(Arc::new(config)),
            name,
        })
    }
}

impl ServerTls {
    /// Lets paths count from a folder.
    pub fn resolve(&mut self, folder: &Path) {
        for path in [&mut self.certificate, &mut self.key, &mut self.client_ca] {
            resolve(Some(path), folder);
        }
    }

    /// Reads the files.
    ///
    /// # Errors
    /// `Error::Config` names the file.
    pub fn open(&self, place: &str) -> Result<TlsAcceptor, Error> {
        let clients = Arc::new(authorities(place, "tls.client_ca", &self.client_ca)?);
        let verifier = WebPkiClientVerifier::builder_with_provider(clients, provider())
            .build()
            .map_err(|error| file(place, "tls.client_ca", &self.client_ca, &error.to_string()))?;
        let config = ServerConfig::builder_with_provider(provider())
            .with_safe_default_protocol_versions()
            .map_err(|error| Error::config(place, format!("TLS cannot be used: {error}")))?
            .with_client_cert_verifier(verifier)
            .with_single_cert(
                chain(place, "tls.certificate", &self.certificate)?,
                private(place, "tls.key", &self.key)?,
            )
            .map_err(|error| mismatch(place, &self.key, &self.certificate, &error))?;
        Ok(TlsAcceptor::from(Arc::new(config)))
    }
}

/// A client's settings, ready for connections.
#[derive(Clone)]
pub(crate) struct Tls {
    pub(crate) connector: TlsConnector,
    pub(crate) name: ServerName<'static>,
}

impl std::fmt::Debug for Tls {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Tls").field("name", &self.name).finish_non_exhaustive()
    }
}

fn provider() -> Arc<CryptoProvider> {
    Arc::new(ring::default_provider())
}

fn resolve(path: Option<&mut PathBuf>, folder: &Path) {
    if let Some(path) = path {
        *path = folder.join(&*path);
    }
}

fn file(place: &str, key: &str, path: &Path, problem: &str) -> Error {
    Error::config(place, format!("{key} = {path:?}: {problem}"))
}

fn mismatch(place: &str, key: &Path, certificate: &Path, error: &dyn std::error::Error) -> Error {
    let cure = format!("use the key that {certificate:?} was made with");
    file(place, "tls.key", key, &format!("{error}; {cure}"))
}

fn read(place: &str, key: &str, path: &Path) -> Result<Vec<u8>, Error> {
    let unreadable = |error: std::io::Error| {
        let cure = "check the path, which counts from the configuration's folder, and its rights";
        file(place, key, path, &format!("it cannot be read ({error}); {cure}"))
    };
    let size = std::fs::metadata(path).map_err(unreadable)?.len();
    if size > FILE_BYTES_MAX {
        let problem = format!("it has {size} bytes; certificates and keys have at most {FILE_BYTES_MAX}");
        return Err(file(place, key, path, &problem));
    }
    std::fs::read(path).map_err(unreadable)
}

fn chain(place: &str, key: &str, path: &Path) -> Result<Vec<CertificateDer<'static>>, Error> {
    let bytes = read(place, key, path)?;
    let found: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&bytes).collect();
    match found {
        Ok(chain) if !chain.is_empty() => Ok(chain),
        Ok(_) => Err(file(
            place,
            key,
            path,
            "it holds no certificate; give a PEM file with BEGIN CERTIFICATE",
        )),
        Err(error) => Err(file(
            place,
            key,
            path,
            &format!("{error}; give a PEM file with BEGIN CERTIFICATE"),
        )),
    }
}

fn private(place: &str, key: &str, path: &Path) -> Result<PrivateKeyDer<'static>, Error> {
    let bytes = read(place, key, path)?;
    PrivateKeyDer::from_pem_slice(&bytes).map_err(|error| {
        let cure = "give a PEM file with an unencrypted PRIVATE KEY";
        file(place, key, path, &format!("{error}; {cure}"))
    })
}

fn authorities(place: &str, key: &str, path: &Path) -> Result<RootCertStore, Error> {
    let mut store = RootCertStore::empty();
    for certificate in chain(place, key, path)? {
        store.add(certificate).map_err(|error| {
            file(
                place,
                key,
                path,
                &format!("{error}; give the authority's own certificate"),
            )
        })?;
    }
    Ok(store)
}
