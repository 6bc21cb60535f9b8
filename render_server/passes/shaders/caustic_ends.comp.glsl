// Ends the beams that were sent (common/beam_ends.glsl).
#include "common/geometry.glsl"
#define APPENDS_BEAMS
#include "common/beams.glsl"
#include "common/walk.glsl"
#include "common/camera.glsl"
#include "common/beam_ends.glsl"

layout(local_size_x = 64) in;

void end(SentBeam sent) {
    Beam beam;
    if (ends(sent, beam)) append_beam(beam);
}

void main() {
    uint count = beams_sent(), i = first_item();
    if (i < count) do end(sent_beams[i]); while ((i += items_apart()) < count);
}
