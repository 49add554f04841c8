//! Compiled components on disk: one file per component digest and engine, authenticated before it is believed.
//!
//! Owns: the folder, its file format, and the only place where code is loaded from bytes.
//! Never: is needed: whatever is wrong with a file, the component is compiled again and the reason is logged.
//!
//! File: `<component digest>-<first 16 digits of the engine's hash>.cwasm`, holding
//! ```text
//! 32 bytes  HMAC-SHA256 over all that follows, with the host's own key
//!  8 bytes  magic and format version, "BLCODE01"
//! 32 bytes  SHA-256 of the component
//! 32 bytes  SHA-256 of the engine's compatibility hash and the profile
//!  rest     wasmtime's compiled code
//! ```

use std::{
    fs,
    hash::{Hash as _, Hasher},
    io::{self, Write as _},
    os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _, PermissionsExt as _},
    path::{Path, PathBuf},
    time::{Duration, SystemTime},
};

use bumpless_core::Digest;
use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::{Digest as _, Sha256};

use crate::{Error, Profile, compile::unique, error::brief};

const MAGIC: &[u8; 8] = b"BLCODE01";
const MAC_BYTES: usize = 32;
const HEADER_BYTES: usize = MAGIC.len() + 32 + 32;

/// Far longer than a compilation or a write takes: a hidden entry of that age belongs to nobody alive.
const LEFT_BEHIND_AFTER: Duration = Duration::from_secs(3600);

/// The folder of compiled code.
pub(crate) struct Cache {
    dir: PathBuf,
    key: [u8; 32],
    engine: [u8; 32],
    files_max: usize,
}

impl Cache {
    /// Opens the folder; makes it, open to its owner only, where it is missing.
    pub(crate) fn open(
        dir: PathBuf,
        key: [u8; 32],
        files_max: usize,
        engine: &wasmtime::Engine,
        profile: Profile,
    ) -> Result<Self, Error> {
        fs::DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(&dir)
            .map_err(Error::file("creating", &dir))?;
        fs::set_permissions(&dir, fs::Permissions::from_mode(0o700)).map_err(Error::file("closing to others", &dir))?;
        let mut hash = Fingerprint(Sha256::new());
        engine.precompile_compatibility_hash().hash(&mut hash);
        hash.write(profile.name().as_bytes());
        let cache = Self {
            dir,
            key,
            engine: hash.0.finalize().into(),
            files_max,
        };
        cache.sweep();
        Ok(cache)
    }

    /// The folder.
    pub(crate) fn dir(&self) -> &Path {
        &self.dir
    }

    /// Compiled code of a component, if there is a file and every byte of it is ours.
    pub(crate) fn load(&self, digest: &Digest, engine: &wasmtime::Engine) -> Option<wasmtime::component::Component> {
        let path = self.path(digest);
        let bytes = match fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return None,
            Err(error) => {
                tracing::warn!(path = %path.display(), %error, "compiled code cannot be read; compiling again");
                return None;
            }
        };
        let loaded = self
            .open_file(digest, &bytes)
            .and_then(|code| deserialize(engine, code).map_err(|e| brief(&e)));
        match loaded {
            Ok(component) => Some(component),
            Err(reason) => {
                tracing::warn!(path = %path.display(), %reason, "compiled code is not used; compiling again");
                None
            }
        }
    }

    /// The code in a file, or why it is not ours.
    fn open_file<'a>(&self, digest: &Digest, bytes: &'a [u8]) -> Result<&'a [u8], String> {
        let (mac, rest) = bytes.split_at_checked(MAC_BYTES).ok_or("the file is cut short")?;
        let (header, code) = rest.split_at_checked(HEADER_BYTES).ok_or("the file is cut short")?;
        self.mac(header, code)?
            .verify_slice(mac)
            .map_err(|_| "it was not written by this host, or was changed since")?;
        if header != self.header(digest) {
            return Err("it belongs to another component or engine".to_owned());
        }
        Ok(code)
    }

    /// Keeps compiled code. A failure is logged and costs a compilation at the next start, nothing else.
    pub(crate) fn store(&self, digest: &Digest, code: &[u8]) {
        if let Err(error) = self.write(digest, code) {
            let reason: &dyn std::error::Error = &error;
            tracing::warn!(reason, source = reason.source(), "compiled code is not kept");
        }
        self.prune();
    }

    fn write(&self, digest: &Digest, code: &[u8]) -> Result<(), Error> {
        let header = self.header(digest);
        let mac = self
            .mac(&header, code)
            .map_err(|reason| Error::Engine { reason })?
            .finalize()
            .into_bytes();
        let path = self.path(digest);
        let temporary = self.dir.join(format!(".{digest}-{}-{}", std::process::id(), unique()));
        let write = || {
            let mut file = private(&temporary)?;
            [mac.as_slice(), &header, code]
                .iter()
                .try_for_each(|part| file.write_all(part))?;
            // Without this a power cut could leave a name without its bytes; the MAC would notice, but it costs a compilation.
            file.sync_all()?;
            fs::rename(&temporary, &path)
        };
        write().map_err(|error| {
            drop(fs::remove_file(&temporary));
            Error::file("writing", &path)(error)
        })
    }

    /// Removes a component's code.
    pub(crate) fn remove(&self, digest: &Digest) {
        let path = self.path(digest);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                tracing::warn!(path = %path.display(), %error, "compiled code cannot be removed");
            }
            _ => {}
        }
    }

    /// Removes what a host that was killed left half done: a later one must not fill its disk with it.
    fn sweep(&self) {
        let Ok(entries) = fs::read_dir(&self.dir) else { return };
        for entry in entries
            .flatten()
            .filter(|e| e.file_name().as_encoded_bytes().starts_with(b"."))
        {
            let age = entry
                .metadata()
                .and_then(|m| m.modified())
                .ok()
                .and_then(|t| t.elapsed().ok());
            if age.is_some_and(|age| age > LEFT_BEHIND_AFTER) {
                let path = entry.path();
                let removed = if path.is_dir() {
                    fs::remove_dir_all(&path)
                } else {
                    fs::remove_file(&path)
                };
                if let Err(error) = removed {
                    tracing::warn!(path = %path.display(), %error, "what an earlier host left behind cannot be removed");
                }
            }
        }
    }

    /// Removes the oldest files beyond the limit, those of earlier engines among them.
    fn prune(&self) {
        let Ok(entries) = fs::read_dir(&self.dir) else { return };
        let mut files: Vec<(SystemTime, PathBuf)> = entries
            .flatten()
            .filter(|e| e.path().extension().is_some_and(|x| x == "cwasm"))
            .filter_map(|e| Some((e.metadata().ok()?.modified().ok()?, e.path())))
            .collect();
        files.sort_unstable();
        let surplus = files.len().saturating_sub(self.files_max);
        for (_, path) in files.iter().take(surplus) {
            if let Err(error) = fs::remove_file(path) {
                tracing::warn!(path = %path.display(), %error, "old compiled code cannot be removed");
            }
        }
    }

    fn path(&self, digest: &Digest) -> PathBuf {
        let engine = Digest::from_bytes(self.engine).to_string();
        self.dir
            .join(format!("{digest}-{}.cwasm", engine.get(..16).unwrap_or(&engine)))
    }

    fn header(&self, digest: &Digest) -> [u8; HEADER_BYTES] {
        let mut header = [0; HEADER_BYTES];
        let parts = MAGIC.iter().chain(digest.as_bytes()).chain(&self.engine);
        header.iter_mut().zip(parts).for_each(|(to, from)| *to = *from);
        header
    }

    fn mac(&self, header: &[u8], code: &[u8]) -> Result<Hmac<Sha256>, String> {
        let mut mac = Hmac::<Sha256>::new_from_slice(&self.key).map_err(|error| error.to_string())?;
        mac.update(header);
        mac.update(code);
        Ok(mac)
    }
}

/// Loads compiled code.
///
/// `code` must be authenticated, or come straight from this host's own compiler; both callers see to it.
pub(crate) fn deserialize(engine: &wasmtime::Engine, code: &[u8]) -> wasmtime::Result<wasmtime::component::Component> {
    // SAFETY: `code` is the output of `precompile_component` of this very program: either it was just returned by it or by
    // our own compiling child through a folder that is closed to others, or it was written by `Cache::write` and its
    // HMAC-SHA256 with this host's own key was verified over these same bytes in memory. wasmtime itself refuses code of
    // another version or other settings.
    #[allow(unsafe_code, reason = "loading compiled code is unsafe by nature; see SAFETY")]
    unsafe {
        wasmtime::component::Component::deserialize(engine, code)
    }
}

/// Takes everything that is hashed into a SHA-256, for a file name must not depend on the process.
struct Fingerprint(Sha256);

impl Hasher for Fingerprint {
    fn write(&mut self, bytes: &[u8]) {
        self.0.update(bytes);
    }

    fn finish(&self) -> u64 {
        let digest = self.0.clone().finalize();
        digest.iter().take(8).fold(0, |n, byte| n << 8 | u64::from(*byte))
    }
}

/// The key that authenticates this host's compiled code: read from `path`, or drawn and written there with mode 0600.
///
/// It never leaves the host. Losing it costs one compilation of each component.
///
/// # Errors
/// [`Error::File`] where the file cannot be read or made, [`Error::Key`] where it does not hold 32 bytes.
pub fn cache_key(path: &Path) -> Result<[u8; 32], Error> {
    if !path.exists() {
        let mut key = [0; 32];
        getrandom::fill(&mut key).map_err(|error| Error::file("drawing a key for", path)(io::Error::other(error)))?;
        let temporary = path.with_extension(format!("{}-{}", std::process::id(), unique()));
        let made = private(&temporary).and_then(|mut file| {
            file.write_all(&key)?;
            file.sync_all()?;
            // A link and not a rename: of two processes that start at once the first wins and the second reads its key.
            match fs::hard_link(&temporary, path) {
                Err(error) if error.kind() != io::ErrorKind::AlreadyExists => Err(error),
                _ => Ok(()),
            }
        });
        drop(fs::remove_file(&temporary));
        made.map_err(Error::file("creating", path))?;
    }
    let bytes = fs::read(path).map_err(Error::file("reading", path))?;
    let length = bytes.len() as u64;
    bytes.try_into().map_err(|_| Error::Key {
        path: path.to_owned(),
        bytes: length,
    })
}

/// A new file that only its owner may read.
fn private(path: &Path) -> io::Result<fs::File> {
    fs::OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(path)
}
