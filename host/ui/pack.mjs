// Packs what was built: each file beside itself with gzip and brotli, and a count of what travels. Fails above the limit.
// `node pack.mjs clean` empties the folder first.
import { readdirSync, readFileSync, rmSync, statSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { brotliCompressSync, constants, gzipSync } from "node:zlib";

const FOLDER = new URL("./dist/", import.meta.url).pathname;
const LIMIT_BYTES = 300_000;

if (process.argv[2] === "clean") {
  for (const name of readdirSync(FOLDER)) {
    if (!name.startsWith(".")) rmSync(join(FOLDER, name), { recursive: true });
  }
  process.exit(0);
}

let plain = 0;
let packed = 0;
for (const name of readdirSync(FOLDER, { recursive: true })) {
  const path = join(FOLDER, name);
  if (!statSync(path).isFile() || /(^|\/)\.|\.(gz|br)$/.test(name)) continue;
  const bytes = readFileSync(path);
  const gzip = gzipSync(bytes, { level: 9 });
  writeFileSync(`${path}.gz`, gzip);
  writeFileSync(
    `${path}.br`,
    brotliCompressSync(bytes, { params: { [constants.BROTLI_PARAM_QUALITY]: 11 } }),
  );
  plain += bytes.length;
  packed += gzip.length;
}
console.log(`page: ${plain} bytes, ${packed} with gzip`);
if (packed > LIMIT_BYTES) {
  console.error(`page: more than ${LIMIT_BYTES} bytes travel; leave something out`);
  process.exit(1);
}
