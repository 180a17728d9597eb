// Group G: files, configurations, checkpoints, plugins.
#include "input_parts.h"

namespace semfield::numerics {

namespace {

constexpr Case kCases[] = {
    {"G01", "img-lies", "images whose headers state up to 2^32 pixels over a body of bytes", "refused; MiB grown",
     lying_images},
    {"G02", "img-odd", "0 x 0, 1 x 1, palette, 16-bit, 1 to 4 bits, interlaced, cut short", "exact", odd_images},
    {"G03", "label-depth-size", "frames whose files differ in size, are missing, stand twice", "exact",
     frame_files_at_odds},
    {"G04", "exr-nan", "EXR depth of NaN, +-inf, negative and sound pixels", "exact", float_depth},
    {"G05", "depth-special", "depth of 0, 65535 and NaN", "pixels left out of bounds, metrics and losses",
     special_depth},
    {"G06", "yaml-deep", "1e5 open brackets, braces, dashes, quotes", "refused; CPU s", deep_yaml},
    {"G07", "yaml-bomb", "aliases nine deep, an alias of itself", "refused; CPU s", alias_bombs},
    {"G08", "yaml-mistakes", "unknown and double keys, 1e400, .nan, no, 010", "line and column", yaml_mistakes},
    {"G09", "ckpt-flip", "1e4 flipped bits of a checkpoint", "all refused", checkpoint_flips},
    {"G10", "ckpt-trunc", "1,000 lengths of a checkpoint", "refused; one before", checkpoint_cuts},
    {"G11", "ckpt-shape", "headers with overflow, overlap, holes, double keys, NaN weights", "all refused",
     checkpoint_shapes},
    {"G12", "plugin-bad", "modules of another ABI, processor or version, cut short, throwing", "refused; host lives",
     broken_plugins},
    {"G18", "disk/mem", "saves with no room in the file and no file handle left", "the old checkpoint", full_disk},
};

}  // namespace

std::span<const Case> input_cases() { return kCases; }

}  // namespace semfield::numerics
