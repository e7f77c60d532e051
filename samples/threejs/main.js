// A room whose light changes with the hour of a slider, a ball under light probes, and smoke under a sun of the same hour.
import * as THREE from 'three';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';
import { LightProbeGridWebGL } from 'three/addons/lighting/LightProbeGridWebGL.js';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { KTX2Loader } from 'three/addons/loaders/KTX2Loader.js';
import { loadLightmap } from './light/lightmap.js';
import { loadLightProbeGrid } from './probes_06/grid.js';
import { loadSmoke } from './smoke/smoke.js';

const renderer = new THREE.WebGLRenderer({ antialias: true });
renderer.toneMapping = THREE.ReinhardToneMapping;
renderer.toneMappingExposure = 4;
document.body.append(renderer.domElement);
const camera = new THREE.PerspectiveCamera(50, 1, 0.1, 100);
camera.position.set(0, 1.5, 5.6);
const controls = new OrbitControls(camera, renderer.domElement);
controls.target.set(0, 1.4, 0);
const resize = () => {
  renderer.setSize(innerWidth, innerHeight);
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
};
addEventListener('resize', resize);
resize();

const beside = (name) => new URL(name, document.baseURI).href, scene = new THREE.Scene();
const room = (await new GLTFLoader().loadAsync('room.glb')).scene;
const light = await loadLightmap(beside('light/bundle.json'), renderer, THREE);
room.traverse((mesh) => {
  if (!mesh.isMesh) return;
  // A material without reflections: the lightmap has all of the light.
  mesh.material = new THREE.MeshBasicMaterial({ color: mesh.material.color });
  light.apply(mesh.material, 1);
});

// A grid of probes for each stored hour, and one that mixes two of them, which three.js reads.
const HOURS = [6, 8, 12, 17, 20];
const load = (name) => loadLightProbeGrid(beside(name), renderer, THREE, KTX2Loader, LightProbeGridWebGL);
const grids = await Promise.all(HOURS.map((hour) => load(`probes_${String(hour).padStart(2, '0')}/grid.json`)));
const probes = await load('probes_06/grid.json');
function mixProbes(hour) {
  const k = Math.min(HOURS.findLastIndex((each) => each <= hour), HOURS.length - 2);
  const share = (hour - HOURS[k]) / (HOURS[k + 1] - HOURS[k]), { fromHalfFloat, toHalfFloat } = THREE.DataUtils;
  const [early, late, mixed] = [grids[k], grids[k + 1], probes].map((grid) => grid.texture.image.data);
  mixed.forEach((_, i) => {
    mixed[i] = toHalfFloat((1 - share) * fromHalfFloat(early[i]) + share * fromHalfFloat(late[i]));
  });
  probes.texture.needsUpdate = true;
}
const ball = new THREE.Mesh(new THREE.SphereGeometry(0.3, 48, 24), new THREE.MeshLambertMaterial({ color: 0xffffff }));
scene.add(room, probes, ball);

// Smoke and its lights are a scene of their own, since the lights of a scene of three.js light all that is in it.
const air = new THREE.Scene(), sun = new THREE.DirectionalLight(), sky = new THREE.AmbientLight();
const smoke = await loadSmoke(beside('smoke/bundle.json'), THREE);
smoke.mesh.position.set(0.9, 0.8, 1.5);
air.add(smoke.mesh, sun, sky);

const slider = document.getElementById('hour');
function setHour(hour) {
  light.setTime(hour);
  mixProbes(hour);
  // The sun goes from the east, +x, over the room to the west; after 18 h the lamp lights the smoke from above.
  const turn = Math.PI * (hour - 6) / 12, day = hour < 18;
  sun.position.set(day ? Math.cos(turn) : 0, day ? Math.sin(turn) : 1, day ? 0.6 : 0.1);
  sun.intensity = day ? 1.5 * Math.sin(turn) : 0.4;
  sky.color.setHex(day ? 0x8c9ab4 : 0x302820);
  document.getElementById('shown').value = `${Math.floor(hour)}:${String(Math.floor(hour % 1 * 60)).padStart(2, '0')}`;
}
slider.addEventListener('input', () => setHour(Number(slider.value)));
setHour(Number(slider.value));
renderer.setAnimationLoop((milliseconds) => {
  controls.update();
  smoke.setTime(milliseconds / 1000);
  ball.position.set(0.9 * Math.sin(milliseconds / 2000), 1.1, 0.9);  // within the box of the probes
  renderer.autoClear = true;
  renderer.render(scene, camera);
  renderer.autoClear = false;
  renderer.render(air, camera);
});
