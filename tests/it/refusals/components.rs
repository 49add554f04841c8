//! Bytes that are no controller, and controllers that lie or do not end.

use bumpless_tests::{Api, components};

use super::problem;

pub(super) fn refused(api: &Api) {
    let folder = components().unwrap();
    let read = |name: &str| std::fs::read(folder.join(format!("{name}.wasm"))).unwrap();
    let pid = read("pid");
    // The same component with a custom section more: same name and version, another digest.
    let other: Vec<u8> = [pid.as_slice(), &[0, 5, 4], b"note"].concat();
    let half = pid.get(..pid.len() / 2).unwrap_or_default().to_vec();
    let table: [(&str, Vec<u8>, u16, &str); 11] = [
        ("nothing", Vec::new(), 422, "the body is empty"),
        ("a text", b"(component)".to_vec(), 422, "no WebAssembly component"),
        ("a core module", b"\0asm\x01\0\0\0".to_vec(), 422, "a core module"),
        ("half a component", half, 422, "does not compile"),
        ("more than allowed", vec![0; 32 * 1024 * 1024 + 1], 413, "longer than"),
        (
            "a disk's user",
            read("guests/forbidden-import"),
            422,
            "outside:disk/files@1.0.0",
        ),
        (
            "another world",
            read("guests/wrong-world"),
            422,
            "no controller of the world",
        ),
        (
            "endless describe",
            read("guests/describe-spins"),
            422,
            "cannot say what it is",
        ),
        (
            "a liar",
            read("guests/lies-in-describe"),
            422,
            "what the component says of itself",
        ),
        ("another pid 0.1.0", other, 409, "raise"),
        (
            "a name of its own",
            b"\x7fELF".to_vec(),
            422,
            "no WebAssembly component",
        ),
    ];
    for (case, bytes, status, part) in table {
        problem(case, api.upload_bytes(&bytes), status, part);
    }
    // The same bytes again are no news, and no fault.
    let again = api.upload_bytes(&pid).unwrap();
    assert_eq!(again["name"], "pid");
}
