
// Fills a cascaded lighting volume as the viewer moves: compute shaders for GLSL 4.30 and later, or Vulkan.
// The document explains in which order they run, and what the engine writes in each frame; see "about" there.
//
// Buffer head, as the buffer volume of the shader that reads the volume. Buffers pages and pool, as there.
// Buffer index, 32-bit words: the Morton keys of the blocks near probes, low and high word, level after level, sorted;
//        then @record@ words for each probe, sorted by cell: Morton key of the cell, two words; number among the
//        live probes; 3 floats, place in the cell, 0 to 1; 3 floats, normal; 3 floats, place in the probes' box
// Buffer tables, integers: row of each block near probes, or -1; then, if the pool has fewer rows than that, the last
//        frame in which each row was in a window, or -1, and its block
// Buffer counts, integers: blocks gathered in this frame, blocks that waited, then a histogram of distances
// Buffers work and light: data that the dispatches of a frame pass on.
@buffers@
const int WLM_UPDATE_OUTPUTS = @outputs@;
const int WLM_UPDATE_BUDGET = @budget@; // most blocks decoded in a frame
const int WLM_UPDATE_MOST = @most@; // most blocks that are ranked
const int WLM_UPDATE_RANKED = @ranked@; // words of the buffer work before the parts with these names
const int WLM_UPDATE_RANGES = @ranges@;
const int WLM_UPDATE_PICKS = @picks@;
const int WLM_UPDATE_WEIGHTS = @weights@; // floats of the buffer light before the weights
const int WLM_UPDATE_ROW_WORDS = @row_words@;
