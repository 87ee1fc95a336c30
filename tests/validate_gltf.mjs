// Prints the errors, warnings and their messages that the Khronos validator finds in each .glb file named, as JSON.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";

const validator = createRequire(process.env.GLTF_VALIDATOR)("gltf-validator");
for (const path of process.argv.slice(2)) {
  const { issues } = await validator.validateBytes(new Uint8Array(readFileSync(path)), { maxIssues: 0 });
  const messages = issues.messages.filter((each) => each.severity < 2).map((each) => `${each.pointer}: ${each.message}`);
  console.log(JSON.stringify({ path, errors: issues.numErrors, warnings: issues.numWarnings, messages: messages.slice(0, 5) }));
}
