// Reads a GLB with KHR_gaussian_splatting by Babylon.js, without a picture, and writes what its loader
// makes of it: 32 bytes a Gaussian, the layout of .splat.
//
//     node glb_by_babylon.mjs NODE_MODULES IN.glb OUT.splat
import { readFileSync, writeFileSync } from "node:fs";
import { resolve } from "node:path";

const [modules, source, output] = process.argv.slice(2);
const load = (path) => import(`file://${resolve(modules)}/@babylonjs/${path}`);
const { NullEngine } = await load("core/Engines/nullEngine.js");
const { Scene } = await load("core/scene.js");
const { ImportMeshAsync } = await load("core/Loading/sceneLoader.js");
const { GaussianSplattingMesh } = await load(
  "core/Meshes/GaussianSplatting/gaussianSplattingMesh.js",
);
await load("loaders/glTF/2.0/index.js");

let found = null;
GaussianSplattingMesh.prototype.updateDataAsync = async (data) => {
  found = new Uint8Array(data);
};
const bytes = readFileSync(source);
const url = `data:;base64,${bytes.toString("base64")}`;
await ImportMeshAsync(url, new Scene(new NullEngine()), { pluginExtension: ".glb" });
writeFileSync(output, found);
process.exit(0);
