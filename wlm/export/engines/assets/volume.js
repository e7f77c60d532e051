// Fills a cascaded lighting volume on the GPU as the camera moves, and lights node materials from it.
// For WebGPURenderer of three.js, r187 and later; the folder is the `update` of `wlm probe volume --update --shader wgsl`.
//
//     import * as THREE from 'three/webgpu';
//     import * as TSL from 'three/tsl';
//     const volume = await WlmVolume.load('update/', renderer, THREE);
//     material.colorNode = volume.diffuse(TSL, TSL.positionWorld, TSL.normalWorld).mul(albedo);
//     // in each frame, before rendering:
//     volume.update(camera.position);
//
// The light is the radiance of a white diffuse surface, irradiance over pi. A frame decodes at most `budget` blocks.
export class WlmVolume
{
    static async load(url, renderer, THREE)
    {
        const at = name => new URL(name, new URL(url, document.baseURI));
        const text = async name => (await fetch(at(name))).text();
        const words = async name => new Uint32Array(await (await fetch(at(name))).arrayBuffer());
        await renderer.init();
        const volume = new WlmVolume();
        volume.info = await (await fetch(at('bundle.json'))).json();
        volume.device = renderer.backend.device;
        volume.frame = 0;
        volume.base = null;
        volume.viewpoint = new THREE.Vector3();
        volume.read = await text('read.wgsl');
        const contents = {};
        for (const [name, buffer] of Object.entries(volume.info.buffers))
            contents[name] = await words(buffer.file);
        for (const [name, count] of Object.entries(volume.info.words)) {
            const first = name === 'head' ? contents.head.slice(0, count) : new Uint32Array(count);
            contents[name] = name === 'pages' || name === 'tables' ? first.fill(0xffffffff) : first;
        }
        volume.head = contents.head;
        volume.buffers = {};
        volume.attributes = {};
        for (const [name, content] of Object.entries(contents)) {
            const attribute = new THREE.StorageBufferAttribute(content, 1);
            renderer.backend.createStorageAttribute(attribute);
            volume.attributes[name] = attribute;
            volume.buffers[name] = renderer.backend.get(attribute).buffer;
        }
        await volume.compile(await text('probe.wgsl'));
        return volume;
    }

    async compile(code)
    {
        const places = {};
        for (const [, place, name] of code.matchAll(/@binding\((\d+)\) var<[^>]*> wlm_[a-z]+_(\w+):/g))
            places[name] = Number(place);
        const mains = this.info.dispatches.map((step, i) => '@compute @workgroup_size(64) fn main_' + i +
            '(@builtin(global_invocation_id) id: vec3u) { ' + step.function + '(i32(id.x)); }\n');
        const module = this.device.createShaderModule({ code: code + mains.join('') });
        this.steps = await Promise.all(this.info.dispatches.map(async (step, i) => {
            const compute = { module, entryPoint: 'main_' + i };
            const pipeline = await this.device.createComputePipelineAsync({ layout: 'auto', compute });
            const entries = step.buffers.map(name => ({ binding: places[name], resource: { buffer: this.buffers[name] } }));
            const group = this.device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries });
            return { pipeline, group, count: Math.ceil(step.threads / 64) };
        }));
    }

    // Moves the volume to a viewpoint, and fills up to `budget` of the missing blocks.
    update(viewpoint)
    {
        const ints = new Int32Array(this.head.buffer), floats = new Float32Array(this.head.buffer);
        this.viewpoint.copy(viewpoint);
        this.head[4] = ++this.frame;
        const base = this.info.levels.map((level, i) => [0, 1, 2].map(axis => {
            const place = viewpoint.getComponent(axis) / level.block - level.start[axis], word = 8 + 16 * i + axis;
            const side = level.sides[axis];
            const first = Math.max(Math.floor(place + 0.5) - Math.floor(side / 2), level.low[axis]);
            const own = Math.min(first, level.high[axis] + 1 - side);
            floats[word] = place - own - 0.5;
            ints[word + 4] = own;
            ints[word + 12] = this.base ? this.base[i][axis] : own + side;
            return own;
        }));
        this.base = base;
        this.device.queue.writeBuffer(this.buffers.head, 0, this.head);
        const encoder = this.device.createCommandEncoder();
        const run = encoder.beginComputePass();
        for (const { pipeline, group, count } of this.steps) {
            run.setPipeline(pipeline);
            run.setBindGroup(0, group);
            run.dispatchWorkgroups(count);
        }
        run.end();
        this.device.queue.submit([encoder.finish()]);
    }

    // A node with the light of a white diffuse surface at a position with a unit normal, both in world space.
    diffuse(TSL, position, normal)
    {
        const at = this.read.lastIndexOf('fn wlm_volume_diffuse(');
        const diffuse = TSL.wgslFn(this.read.slice(at), [TSL.wgsl(this.read.slice(0, at))]);
        const buffer = name => TSL.storage(this.attributes[name], 'uint', this.attributes[name].count).toReadOnly();
        const place = position.sub(TSL.uniform(this.viewpoint));
        return diffuse({ p: place, n: normal, wlm_volume_head: buffer('head'), wlm_volume_page: buffer('pages'),
                         wlm_volume_pool: buffer('pool') });
    }
}
