// Group C: encoders.
#include "encoder_box.h"

namespace semfield::numerics {

namespace {

constexpr Case kCases[] = {
    {"C01", "pe-L10", "10 bands, |x| up to 1", "113-bit sine", pe_ten_bands},
    {"C02", "pe-L40-stored-x", "40 bands at fp32 coordinates up to 1, 10 and 2^20", "113-bit sine", pe_stored_x},
    {"C03", "pe-L40-geometry", "o + t d of a 10 m room through 40 bands", "113-bit sine", pe_geometry},
    {"C04", "pe-grad", "gradients of single bands up to k = 39", "113-bit cosine", pe_gradient},
    {"C05", "double-angle", "a recurrence over bands", "113-bit sine", pe_double_angle},
    {"C06", "pe-bad", "NaN, infinities, 1e30 in any row", "named error", pe_bad_input},
    {"C07", "dir", "zero, axis, unnormalised and NaN directions", "closed form", directions},
    {"C08", "hash-faces", "x on and beside 0, 1/2 and 1, 9^3 corners", "long double", hash_faces},
    {"C09", "hash-continuity", "1 ulp to either side of cell borders", "Lipschitz bound", hash_continuity},
    {"C10", "hash-resolution", "N = 2^10 .. 2^22 cells along an axis", "long double", hash_resolution},
    {"C11", "hash-index", "N = 1,625 .. 4,096: more than 2^32 vertices", "128-bit integers", hash_index},
    {"C12", "hash-fp16-flush", "gradients 1e-12 .. 1e-4 into the table", "long double", hash_small_gradients},
    {"C13", "hash-one-entry", "2^18 samples into one entry, 100 repeats", "long double", hash_one_entry},
    {"C14", "hash-grad", "random points, tables and loss", "differences", hash_gradient},
};

}  // namespace

std::span<const Case> encoder_cases() { return kCases; }

}  // namespace semfield::numerics
