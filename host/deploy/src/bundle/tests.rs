//! Bundles come back as they went; whatever was changed in one is noticed and told.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::indexing_slicing, reason = "tests")]

use bumpless_core::{Descriptor, Direction, PortKind, PortSpec, component::CONTROLLER_WORLD};

use super::*;

fn component(name: &str) -> (ComponentInfo, Vec<u8>) {
    let bytes = format!("the bytes of {name}").into_bytes();
    let output = PortSpec {
        name: "out".into(),
        direction: Direction::Output,
        kind: PortKind::Analog,
        unit: "%".into(),
        required: true,
        text: String::new(),
    };
    let info = ComponentInfo {
        digest: Digest::of(&bytes),
        name: name.into(),
        version: "1.0.0".into(),
        descriptor: Descriptor {
            name: name.into(),
            version: "1.0.0".into(),
            text: "a law".into(),
            ports: vec![output],
            parameters: Vec::new(),
            state_layout: 1,
        },
        world: CONTROLLER_WORLD.into(),
        imports: vec!["bumpless:control/io@0.1.0".into()],
        bytes: bytes.len() as u64,
        uploaded_at_unix_ms: 7,
        uploaded_by: "ann".into(),
        note: format!("the note of {name}"),
        labels: BTreeMap::from([("stage".into(), "pilot".into())]),
        changes: 0,
        history: Vec::new(),
        admission: None,
    };
    (info, bytes)
}

/// Without signatures.
fn packed(components: Vec<(ComponentInfo, Vec<u8>)>) -> Result<Vec<u8>, Error> {
    pack(components, &Signed::new())
}

/// The files of a bundle, to be changed.
fn files(bundle: &[u8]) -> Vec<(String, Vec<u8>)> {
    let list = list(bundle).unwrap();
    list.into_iter().map(|(path, bytes)| (path, bytes.to_vec())).collect()
}

fn tar_of(files: &[(String, Vec<u8>)]) -> Vec<u8> {
    let mut tar = tar::Builder::new(Vec::new());
    for (path, bytes) in files {
        let mut header = tar::Header::new_gnu();
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        tar.append_data(&mut header, path, bytes.as_slice()).unwrap();
    }
    tar.into_inner().unwrap()
}

#[test]
fn a_bundle_comes_back_as_it_went_and_is_an_image_layout() {
    let components = vec![component("a"), component("b")];
    let bundle = packed(components.clone()).unwrap();
    assert_eq!(bundle, packed(components.clone()).unwrap(), "the same every time");
    let entries = unpack(&bundle).unwrap();
    assert_eq!(entries.len(), 2);
    for ((name, parcel), (info, bytes)) in entries.iter().zip(&components) {
        let parcel = parcel.as_ref().unwrap();
        assert_eq!(*name, title(info));
        assert_eq!((&parcel.bytes, parcel.digest), (bytes, info.digest));
        assert_eq!((&parcel.note, &parcel.labels), (&info.note, &info.labels));
    }
    let files: BTreeMap<String, Vec<u8>> = files(&bundle).into_iter().collect();
    assert_eq!(files.len(), 2 + 2 * 3);
    let value = |path: &str| serde_json::from_slice::<serde_json::Value>(&files[path]).unwrap();
    assert_eq!(value("oci-layout")["imageLayoutVersion"], "1.0.0");
    let entry = &value("index.json")["manifests"][0];
    assert_eq!(entry["annotations"][REF_NAME], "a@1.0.0");
    let path = |content: &serde_json::Value| content["digest"].as_str().unwrap().replace("sha256:", BLOBS);
    let manifest = value(&path(entry));
    assert_eq!(manifest["layers"][0]["mediaType"], "application/wasm");
    let config = value(&path(&manifest["config"]));
    assert_eq!(
        (&config["architecture"], &config["bumpless"]["note"]),
        (&"wasm".into(), &"the note of a".into())
    );
    assert_eq!(config["bumpless"]["descriptor"]["ports"][0]["name"], "out");
}

#[test]
fn a_file_that_is_no_bundle_is_refused_in_words() {
    let good = files(&packed(vec![component("a")]).unwrap());
    let with = |path: &str, bytes: &[u8]| {
        let mut files = good.clone();
        files.retain(|(known, _)| known != path);
        files.push((path.to_owned(), bytes.to_vec()));
        tar_of(&files)
    };
    let without = |path: &str| {
        tar_of(
            &good
                .iter()
                .filter(|(known, _)| known != path)
                .cloned()
                .collect::<Vec<_>>(),
        )
    };
    let twice: Vec<_> = good.iter().chain(&good[..1]).cloned().collect();
    let crowd: Vec<_> = (0..=BUNDLE_ENTRIES_MAX)
        .map(|n| (format!("x{n}"), Vec::new()))
        .collect();
    let whole = packed(vec![component("a")]).unwrap();
    let table: [(Vec<u8>, &str); 11] = [
        (Vec::new(), "it has no oci-layout"),
        (vec![0x5a; 4096], "the tar cannot be read"),
        (whole[..1500].to_vec(), "this is no bundle"),
        (without("oci-layout"), "it has no oci-layout"),
        (without("index.json"), "it has no index.json"),
        (
            with("oci-layout", b"{\"imageLayoutVersion\": \"9.0\"}"),
            "version \"9.0\"",
        ),
        (with("index.json", b"{"), "its index.json: EOF"),
        (
            with("index.json", b"{\"schemaVersion\": 2, \"manifests\": []}"),
            "lists 0 components",
        ),
        (
            with("index.json", &vec![b' '; BUNDLE_DOCUMENT_BYTES_MAX + 1]),
            "its index.json has",
        ),
        (tar_of(&twice), "is in it twice"),
        (tar_of(&crowd), "more than"),
    ];
    for (bytes, part) in table {
        let error = unpack(&bytes).expect_err(part);
        assert!(matches!(error, Error::Invalid(_)), "{part}");
        assert!(error.to_string().contains(part), "{part}: {error}");
    }
}

#[test]
fn a_component_that_was_changed_is_told_and_the_others_come_out() {
    let (a, b) = (component("a"), component("b"));
    let bundle = files(&packed(vec![a.clone(), b.clone()]).unwrap());
    let component_path = format!("{BLOBS}{}", a.0.digest);
    type Spoil = Box<dyn Fn(&mut Vec<(String, Vec<u8>)>)>;
    let edit_index = |from: &'static str, to: &'static str| -> Spoil {
        Box::new(move |files| {
            let index = &mut files.iter_mut().find(|(path, _)| path == INDEX).unwrap().1;
            let text = String::from_utf8(index.clone()).unwrap();
            *index = text.replacen(from, to, 1).into_bytes();
        })
    };
    let path = component_path.clone();
    let flip: Spoil = Box::new(move |files| files.iter_mut().find(|(p, _)| *p == path).unwrap().1[0] ^= 1);
    let path = component_path.clone();
    let longer: Spoil = Box::new(move |files| files.iter_mut().find(|(p, _)| *p == path).unwrap().1.push(0));
    let path = component_path.clone();
    let drop: Spoil = Box::new(move |files| files.retain(|(p, _)| *p != path));
    let table: [(Spoil, &str); 6] = [
        (flip, "the component is not what its digest"),
        (longer, "the component is not what its digest"),
        (drop, "is not in the bundle"),
        (edit_index("sha256:", "sha512:"), "which is no SHA-256"),
        (
            edit_index("image.manifest.v1", "image.index.v1"),
            "the entry is of type",
        ),
        (
            edit_index("\"size\": ", "\"size\": 1"),
            "the manifest is not what its digest",
        ),
    ];
    for (spoil, part) in table {
        let mut files = bundle.clone();
        spoil(&mut files);
        let entries = unpack(&tar_of(&files)).unwrap();
        let error = entries[0].1.as_ref().expect_err(part).to_string();
        assert!(error.contains(part), "{part}: {error}");
        assert_eq!(entries[1].1.as_ref().unwrap().bytes, b.1, "{part}");
    }
}

#[test]
fn what_does_not_fit_is_not_packed() {
    assert!(packed(Vec::new()).unwrap_err().to_string().contains("0 components"));
    let (mut info, _) = component("a");
    let bytes = vec![0; COMPONENT_BYTES_MAX];
    info.digest = Digest::of(&bytes);
    let error = packed(vec![(info, bytes); 4]).unwrap_err().to_string();
    assert!(error.contains("make several bundles"), "{error}");
}

/// A bundle for the fuzzers. Written anew with `UPDATE_EXPECT=1`.
#[test]
fn a_bundle_of_an_earlier_day_is_read() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus/bundle/one");
    if std::env::var_os("UPDATE_EXPECT").is_some() {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, pack(vec![component("pid")], &Signed::new()).unwrap()).unwrap();
    }
    let entries = unpack(&std::fs::read(&path).unwrap()).unwrap();
    let (_, parcel) = &entries[0];
    assert_eq!(parcel.as_ref().unwrap().bytes, b"the bytes of pid");
}
