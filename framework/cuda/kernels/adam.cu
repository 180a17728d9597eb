// Adam on the device: all tensors of a run in one launch. Tensors are cut into pieces of kPiece elements, numbered
// through all tensors; a block takes every gridDim.x-th of them.
#include <algorithm>

#include "core/check.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/kernels.h"

namespace semfield::cuda {

namespace {

using Tensor = AdamTensor<float>;

constexpr int kThreads = 256;
constexpr int kPiece = 4 * kThreads;                // 16 bytes of each array a thread
constexpr int kUpdateBlocks = 4, kCheckBlocks = 6;  // a multiprocessor
constexpr int kMostTensors = 4096;                  // their first pieces lie in shared memory

__device__ bool aligned(const float* p) { return reinterpret_cast<std::uintptr_t>(p) % alignof(float4) == 0; }

// Four elements at a time: whole arrays, or rows that never cross eight elements.
__device__ bool by_fours(const Tensor& t) {
  const bool rows_fit = !t.touched_only || t.cols == 1 || t.cols == 2 || t.cols == 4 || t.cols == 8;
  return rows_fit && aligned(t.value) && aligned(t.grad) && aligned(t.moment1) && aligned(t.moment2);
}

// Elements of a piece: whole rows where rows are visited one by one.
__device__ std::int64_t piece_elements(const Tensor& t) {
  if (!t.touched_only || by_fours(t)) return kPiece;
  return t.cols < kPiece ? kPiece / t.cols * t.cols : t.cols;
}

// first[i] = number of the first piece of tensor i, first[count] = all pieces. All threads of the block.
__device__ void number_pieces(const Tensor* tensors, int count, int* first) {
  for (int i = static_cast<int>(threadIdx.x); i < count; i += kThreads) {
    const std::int64_t piece = piece_elements(tensors[i]);
    first[i + 1] = static_cast<int>((tensors[i].rows * tensors[i].cols + piece - 1) / piece);
  }
  if (threadIdx.x == 0) first[0] = 0;
  __syncthreads();
  if (threadIdx.x < kWarp) {
    const int lane = static_cast<int>(threadIdx.x);
    int before = 0;
    for (int base = 0; base < count; base += kWarp) {
      int sum = base + lane < count ? first[base + lane + 1] : 0;
      for (int offset = 1; offset < kWarp; offset *= 2) {
        const int left = __shfl_up_sync(kFullMask, sum, offset);
        if (lane >= offset) sum += left;
      }
      if (base + lane < count) first[base + lane + 1] = before + sum;
      before += __shfl_sync(kFullMask, sum, kWarp - 1);
    }
  }
  __syncthreads();
}

// Bit i: element i of the four belongs to a row with a gradient. All lanes of a warp, which hold consecutive fours.
__device__ unsigned touched_of(const float4& g, std::int32_t cols) {
  unsigned hit = (g.x != 0 ? 1U : 0U) | (g.y != 0 ? 2U : 0U) | (g.z != 0 ? 4U : 0U) | (g.w != 0 ? 8U : 0U);
  if (cols == 1) return hit;
  hit |= (hit & 5U) << 1 | (hit & 10U) >> 1;
  if (cols == 2) return hit;
  hit = hit == 0 ? 0U : 15U;
  return cols == 4 ? hit : hit | __shfl_xor_sync(kFullMask, hit, 1);
}

struct Constants {
  float beta1, one_minus_beta1, beta2, one_minus_beta2, epsilon, root_scale;
};
struct OfTensor {
  float step_size;
  float kept;  // of a value, before the update [Loshchilov19]
};

// [Kingma15, Alg. 1]. The operations of model/optim/adam_kernels.cpp, rounding by rounding.
__device__ void update_element(const Constants& k, const OfTensor& of, float g, float& x, float& m, float& v) {
  m = fmaf(k.beta1, m, k.one_minus_beta1 * g);
  v = fmaf(k.beta2, v, k.one_minus_beta2 * (g * g));
  if (of.kept != 1) x = __fmul_rn(x, of.kept);
  x -= of.step_size * m / fmaf(sqrtf(v), k.root_scale, k.epsilon);
}

// Elements [at, at + n): one row of a table, or any elements of a dense tensor.
__device__ void update_row(const Constants& k, const OfTensor& of, const Tensor& t, std::int64_t at, std::int32_t n) {
  bool touched = !t.touched_only;
  for (std::int32_t i = 0; i < n && !touched; ++i) touched = t.grad[at + i] != 0;
  for (std::int32_t i = 0; i < n && touched; ++i) {
    update_element(k, of, t.grad[at + i], t.value[at + i], t.moment1[at + i], t.moment2[at + i]);
    t.grad[at + i] = 0;
  }
}

__device__ float4 four_at(const float* p) { return *reinterpret_cast<const float4*>(p); }
__device__ float4& four_in(float* p) { return *reinterpret_cast<float4*>(p); }

// Calls f(first element, elements) of each row of the piece, a thread per row; dense tensors: a thread per element.
template <class F>
__device__ void for_rows(const Tensor& t, std::int64_t begin, std::int64_t end, const F& f) {
  const std::int32_t cols = t.touched_only ? t.cols : 1;
  for (std::int64_t at = begin + static_cast<std::int64_t>(threadIdx.x) * cols; at < end; at += kThreads * cols)
    f(at, cols);
}

// The same for up to three elements behind the last four, when they belong to this piece of kPiece elements.
template <class F>
__device__ void for_rest(const Tensor& t, std::int64_t begin, const F& f) {
  const std::int64_t size = t.rows * t.cols, rest = size / 4 * 4;
  if (rest < begin || rest >= begin + kPiece || threadIdx.x != 0) return;
  const std::int32_t n = t.touched_only ? t.cols : 1;  // rows of 4 and 8 leave nothing
  for (std::int64_t at = rest; at < size; at += n) f(at, n);
}

__device__ void update_piece(const Constants& k, const OfTensor& of, const Tensor& t, std::int64_t begin) {
  const std::int64_t size = t.rows * t.cols;
  if (!by_fours(t)) {
    const std::int64_t end = begin + piece_elements(t);
    for_rows(t, begin, end < size ? end : size, [&](std::int64_t at, std::int32_t n) { update_row(k, of, t, at, n); });
    return;
  }
  const std::int64_t at = begin + 4 * static_cast<std::int64_t>(threadIdx.x);
  const bool whole = at + 4 <= size;
  const float4 g = whole ? four_at(t.grad + at) : float4{0, 0, 0, 0};
  const unsigned touched = t.touched_only ? touched_of(g, t.cols) : 15U;
  if (whole && touched != 0) {
    float4 x = four_at(t.value + at), m = four_at(t.moment1 + at), v = four_at(t.moment2 + at);
    if ((touched & 1U) != 0) update_element(k, of, g.x, x.x, m.x, v.x);
    if ((touched & 2U) != 0) update_element(k, of, g.y, x.y, m.y, v.y);
    if ((touched & 4U) != 0) update_element(k, of, g.z, x.z, m.z, v.z);
    if ((touched & 8U) != 0) update_element(k, of, g.w, x.w, m.w, v.w);
    four_in(t.value + at) = x;
    four_in(t.moment1 + at) = m;
    four_in(t.moment2 + at) = v;
    four_in(t.grad + at) = float4{0, 0, 0, 0};
  }
  for_rest(t, begin, [&](std::int64_t rest, std::int32_t n) { update_row(k, of, t, rest, n); });
}

// A piece a block at a time. An element: 16 B read and 16 B written; of a table, 4 B read where no row was touched.
// Elementwise: the same bits for any number of blocks.
__global__ void __launch_bounds__(kThreads, kUpdateBlocks)
    update_kernel(const AdamStep* step, const Tensor* tensors, int count, const FaultKey* fault) {
  extern __shared__ int first[];
  if (fault != nullptr && *fault != kNoFault) return;
  __shared__ Constants k;  // for want of registers; a warp that numbers no pieces fills it
  if (threadIdx.x == kThreads - 1) {
    k.beta1 = static_cast<float>(step->beta1);
    k.one_minus_beta1 = static_cast<float>(1 - step->beta1);
    k.beta2 = static_cast<float>(step->beta2);
    k.one_minus_beta2 = static_cast<float>(1 - step->beta2);
    k.epsilon = static_cast<float>(step->epsilon);
    k.root_scale = static_cast<float>(step->root_scale);
  }
  number_pieces(tensors, count, first);
  int i = 0;
  for (int piece = static_cast<int>(blockIdx.x); piece < first[count]; piece += static_cast<int>(gridDim.x)) {
    while (first[i + 1] <= piece) ++i;
    const Tensor t = tensors[i];
    if (t.semantic && !step->labelled) continue;
    const OfTensor of{static_cast<float>(step->step_size * (t.fades ? t.rate * step->fade : t.rate)),
                      static_cast<float>(1 - step->learning_rate * t.decay)};
    update_piece(k, of, t, (piece - first[i]) * piece_elements(t));
  }
}

__device__ bool sound(float x) { return fabsf(x) <= kLargestSound<float>; }
__device__ bool sound_square(float v) { return v >= 0 && v <= kLargestSound<float> * kLargestSound<float>; }
__device__ bool sound_state(const Tensor& t, std::int64_t at) {
  return sound(t.value[at]) && sound(t.moment1[at]) && sound_square(t.moment2[at]);
}
__device__ bool sound_state_by_fours(const Tensor& t, std::int64_t at) {
  const float4 x = four_at(t.value + at), m = four_at(t.moment1 + at), v = four_at(t.moment2 + at);
  return sound(x.x) && sound(x.y) && sound(x.z) && sound(x.w) && sound(m.x) && sound(m.y) && sound(m.z) && sound(m.w) &&
         sound_square(v.x) && sound_square(v.y) && sound_square(v.z) && sound_square(v.w);
}

// Elements whose values and moments are looked at: of a table one window of rows.
struct Window {
  std::int64_t begin, end;
  __device__ bool has(std::int64_t at) const { return at >= begin && at < end; }
};

__device__ Window window_of(const Tensor& t, std::uint64_t step) {
  if (!t.touched_only) return {0, t.rows * t.cols};
  const std::int64_t rows = (t.rows + kTableWindows - 1) / kTableWindows;
  const std::int64_t begin = static_cast<std::int64_t>(step % kTableWindows) * rows * t.cols;
  return {begin, begin + rows * t.cols};
}

__device__ bool sound_row(const Tensor& t, const Window& window, std::int64_t at, std::int32_t n) {
  bool touched = !t.touched_only, good = true;
  for (std::int32_t i = 0; i < n; ++i) {
    good = good && sound(t.grad[at + i]);
    touched = touched || t.grad[at + i] != 0;
  }
  for (std::int32_t i = 0; i < n && touched && window.has(at); ++i) good = good && sound_state(t, at + i);
  return good;
}

__device__ bool sound_piece(const Tensor& t, std::int64_t begin, const Window& window) {
  const std::int64_t size = t.rows * t.cols;
  bool good = true;
  if (!by_fours(t)) {
    const std::int64_t end = begin + piece_elements(t);
    for_rows(t, begin, end < size ? end : size,
             [&](std::int64_t at, std::int32_t n) { good = good && sound_row(t, window, at, n); });
    return good;
  }
  const std::int64_t at = begin + 4 * static_cast<std::int64_t>(threadIdx.x);
  const bool whole = at + 4 <= size;
  const float4 g = whole ? four_at(t.grad + at) : float4{0, 0, 0, 0};
  const unsigned touched = t.touched_only ? touched_of(g, t.cols) : 15U;
  good = sound(g.x) && sound(g.y) && sound(g.z) && sound(g.w);
  if (whole && touched != 0 && window.has(at)) good = good && sound_state_by_fours(t, at);
  for_rest(t, begin, [&](std::int64_t rest, std::int32_t n) { good = good && sound_row(t, window, rest, n); });
  return good;
}

// A piece a block at a time, the last first, so that the update that follows finds the first of them in cache. An
// element: 16 B read; of a table 4 B, and 12 B more for touched rows of one window in kTableWindows.
__global__ void __launch_bounds__(kThreads, kCheckBlocks)
    check_kernel(const Tensor* tensors, int count, const StepCell* cell, FaultKey* fault) {
  extern __shared__ int first[];
  number_pieces(tensors, count, first);
  const std::uint64_t step = cell == nullptr ? 0 : cell->step;
  int i = count - 1;
  for (int piece = first[count] - 1 - static_cast<int>(blockIdx.x); piece >= 0; piece -= static_cast<int>(gridDim.x)) {
    while (first[i] > piece) --i;
    const Tensor t = tensors[i];
    if (!sound_piece(t, (piece - first[i]) * piece_elements(t), window_of(t, step)))
      note_fault(fault, Stage::gradient, i);
  }
}

// Blocks that take all pieces, of which there are at most elements / kPiece and a part of one a tensor, or more of rows
// that are visited one by one.
unsigned blocks_for(const AdamTable<float>& table, int per_processor) {
  SEMFIELD_CHECK(table.count <= kMostTensors, "too many tensors for one update");
  return static_cast<unsigned>(
      std::min<std::int64_t>(table.elements / kPiece + table.count, multiprocessors() * per_processor));
}

std::size_t shared_bytes(int count) { return sizeof(int) * (static_cast<std::size_t>(count) + 1); }

// The check for values that are not finite.

constexpr int kBlocksPerProcessor = 8;

// Threads stride over the values, four at a time where rows have no gaps; 4 C bytes per row.
__global__ void __launch_bounds__(kThreads)
    guard_kernel(Stage stage, View<const float> values, bool by_fours, FaultKey* fault) {
  const std::int64_t size = values.size(), stride = grid_threads(), thread = thread_index();
  std::int64_t begin = thread;
  if (by_fours) {
    for (std::int64_t i = thread; i < size / 4; i += stride) {
      const float4 v = reinterpret_cast<const float4*>(values.data)[i];
      const float four[4] = {v.x, v.y, v.z, v.w};
      for (int j = 0; j < 4; ++j) {
        if (!isfinite(four[j])) note_fault(fault, stage, (4 * i + j) / values.cols);
      }
    }
    begin += size / 4 * 4;
  }
  for (std::int64_t i = begin; i < size; i += stride) {
    if (!isfinite(values(i / values.cols, static_cast<std::int32_t>(i % values.cols))))
      note_fault(fault, stage, i / values.cols);
  }
}

}  // namespace

void check_gradients(const AdamTable<float>& table) {
  if (table.elements == 0) return;
  check_kernel<<<blocks_for(table, kCheckBlocks), kThreads, shared_bytes(table.count), launch().stream>>>(
      table.tensors, table.count, launch().cell, launch().fault);
  check_launch("check of gradients");
}

void adam_update(const AdamStep* step, const AdamTable<float>& table) {
  if (table.elements == 0) return;
  update_kernel<<<blocks_for(table, kUpdateBlocks), kThreads, shared_bytes(table.count), launch().stream>>>(
      step, table.tensors, table.count, launch().fault);
  check_launch("Adam");
}

void guard_finite(Stage stage, View<const float> values) {
  if (values.empty() || values.size() == 0) return;
  const bool by_fours = values.contiguous() && reinterpret_cast<std::uintptr_t>(values.data) % alignof(float4) == 0;
  const auto most = static_cast<std::int64_t>(multiprocessors()) * kBlocksPerProcessor * kThreads;
  const std::int64_t accesses = by_fours ? values.size() / 4 + 1 : values.size();
  queue("looking for values that are not finite", blocks_of(std::min(accesses, most), kThreads), kThreads, guard_kernel,
        stage, values, by_fours, launch().fault);
}

}  // namespace semfield::cuda
