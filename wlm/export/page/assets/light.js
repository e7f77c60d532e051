// Light of spherical harmonics; conversion of linear light to screen colours: exposure, tone mapping, sRGB, and false
// colours of an error.

const TONES = ['clamped', 'filmic'];

// Radiance of a white diffuse surface under spherical harmonics of radiance: irradiance / pi.
const DIFFUSE = `
vec3 wlm_diffuse(vec3 n, vec3 c[9])
{
    vec3 light = 0.2820948 * c[0] + 0.3257350 * (n.y * c[1] + n.z * c[2] + n.x * c[3]);
    light += 0.2731371 * (n.x * n.y * c[4] + n.y * n.z * c[5] + n.x * n.z * c[7]);
    light += 0.0788479 * (3.0 * n.z * n.z - 1.0) * c[6] + 0.1365686 * (n.x * n.x - n.y * n.y) * c[8];
    return max(light, vec3(0.0));  // few bands ring below 0
}
`;

const DISPLAY = `
uniform float u_exposure;
uniform int u_tone;

vec3 wlm_screen(vec3 light)
{
    vec3 x = max(light * u_exposure, vec3(0.0));
    if (u_tone == 1) x = x * (1.0 + x / 16.0) / (1.0 + x);  // Reinhard's curve, 4 is white
    x = clamp(x, 0.0, 1.0);
    return mix(12.92 * x, 1.055 * pow(max(x, vec3(1e-5)), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, x));
}

// Black, purple, orange, white.
vec3 wlm_heat(float x)
{
    x = clamp(x, 0.0, 1.0);
    vec3 low = mix(vec3(0.0), vec3(0.45, 0.1, 0.5), smoothstep(0.0, 0.33, x));
    vec3 middle = mix(low, vec3(1.0, 0.6, 0.1), smoothstep(0.33, 0.66, x));
    return mix(middle, vec3(1.0), smoothstep(0.66, 1.0, x));
}

uniform int u_view;        // 0 decoded, 1 original, 2 split, 3 error
uniform float u_wipe;      // pixels from the left: the original's side
uniform float u_gain;

// Chooses between decoded light, original and error; the error is that of the displayed picture.
vec3 wlm_shown(vec3 decoded, vec3 original)
{
    vec3 now = wlm_screen(decoded);
    if (u_view == 0) return now;
    vec3 then = wlm_screen(original);
    if (u_view == 1) return then;
    if (u_view == 2) return gl_FragCoord.x < u_wipe ? then : now;
    vec3 apart = abs(now - then);
    return wlm_heat(u_gain * max(apart.x, max(apart.y, apart.z)));
}
`;

const VIEWS = ['decoded', 'original', 'split', 'error'];

// The display state of all kinds of pages, and its controls.
class Display {
  constructor(page, panel, changed) {
    this.values = {u_exposure: page.manifest.exposure, u_tone: page.manifest.tone ?? 0, u_view: 0, u_wipe: 0, u_gain: 8};
    this.share = 0.5;
    this.page = page;
    const stops = (value) => `${value > 0 ? '+' : ''}${value.toFixed(1)} EV`;
    this.stop = panel.slider('exposure', {
      min: -8, max: 8, step: 0.1, value: 0, text: stops, keys: ['[', ']'], by: 0.5,
      changed: (value) => { this.values.u_exposure = page.manifest.exposure * 2 ** value; changed(); },
    });
    const tone = panel.choices('tone', TONES, TONES[this.values.u_tone], (name) => {
      this.values.u_tone = TONES.indexOf(name);
      changed();
    });
    panel.key('t', 'T', 'tone mapping', () => tone(TONES[1 - this.values.u_tone]));
    if (!page.manifest.reference) return;
    const wipe = document.getElementById('wipe');
    this.view = panel.choices('view', VIEWS, VIEWS[0], (name) => {
      this.values.u_view = VIEWS.indexOf(name);
      wipe.hidden = name !== 'split';
      changed();
    }, 1);
    panel.slider('error factor', {
      min: 1, max: 64, step: 1, value: 8, text: (value) => `${value}×`, keys: ['-', '+'],
      changed: (value) => { this.values.u_gain = value; changed(); },
    });
    const place = () => { wipe.style.left = `${100 * this.share}%`; };
    place();
    wipe.onpointerdown = (event) => wipe.setPointerCapture(event.pointerId);
    wipe.onpointermove = (event) => {
      if (!event.buttons) return;
      const box = wipe.parentElement.getBoundingClientRect();
      this.share = Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1);
      place();
      changed();
    };
  }

  // Sets the exposure that the slider starts from.
  expose(factor) {
    this.page.manifest.exposure = factor;
    this.stop(0);
  }

  // Whether the original is visible.
  get compares() { return this.values.u_view > 0; }

  uniforms(width) { return {...this.values, u_wipe: this.share * width}; }
}
