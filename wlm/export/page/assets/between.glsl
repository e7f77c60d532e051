
// Light between principal components: of the probes within four times the distance of the nearest one, weighted by
// 1 / distance^4. WLM_PROBE_OWN(i) reads the positions of the live probes.
vec3 wlm_probe_own(int probe)
{
    return uintBitsToFloat(
        uvec3(WLM_PROBE_OWN(3 * probe), WLM_PROBE_OWN(3 * probe + 1), WLM_PROBE_OWN(3 * probe + 2)));
}

void wlm_probe_sh(vec3 position, out vec3 sh[@COUNT@])
{
    float nearest = 1e30;
    for (int i = 0; i < wlm_probe_count(); ++i) {
        vec3 away = position - wlm_probe_own(i);
        nearest = min(nearest, dot(away, away));
    }
    float total = 0.0;
    for (int c = 0; c < @COUNT@; ++c)
        sh[c] = vec3(0.0);
    for (int i = 0; i < wlm_probe_count(); ++i) {
        vec3 away = position - wlm_probe_own(i);
        float square = dot(away, away);
        if (square > 16.0 * nearest)
            continue;
        float weight = 1.0 / max(square * square, 1e-30);
        vec3 here[@COUNT@];
        wlm_probe_sh(i, here);
        for (int c = 0; c < @COUNT@; ++c)
            sh[c] += weight * here[c];
        total += weight;
    }
    for (int c = 0; c < @COUNT@; ++c)
        sh[c] /= total;
}
