// Loads the light beside this file into a LightProbeGrid, for scene.add().
//
//     import { KTX2Loader } from 'three/addons/loaders/KTX2Loader.js';
//     import { LightProbeGridWebGL } from 'three/addons/lighting/LightProbeGridWebGL.js';
//     scene.add(await loadLightProbeGrid(new URL('grid.json', import.meta.url), renderer, THREE, KTX2Loader,
//                                        LightProbeGridWebGL));
//
// With WebGPURenderer, and up to r185, the class is LightProbeGrid.
export async function loadLightProbeGrid(url, renderer, THREE, KTX2Loader, Grid)
{
    const info = await (await fetch(url)).json();
    const loader = new KTX2Loader().detectSupport(renderer);
    const texture = await loader.loadAsync(new URL(info.texture, new URL(url, document.baseURI)).href);
    loader.dispose();
    texture.minFilter = texture.magFilter = THREE.LinearFilter;
    texture.generateMipmaps = false;
    texture.colorSpace = THREE.NoColorSpace;
    texture.needsUpdate = true;
    const [low, high] = parseInt(THREE.REVISION) >= 187 ? info.box : info.corners;
    const grid = new Grid(high[0] - low[0], high[1] - low[1], high[2] - low[2], ...info.resolution);
    grid.position.set((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2);
    grid.texture = texture;
    grid.updateBoundingBox();
    return grid;
}
