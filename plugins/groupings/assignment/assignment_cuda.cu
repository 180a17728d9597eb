// Assignment on the device: softmax and gradients by a warp per point, the assignment by a block per image.
#include "cuda/kernels/device_code.cuh"
#include "groupings/assignment/assignment.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 128;

// Memory of a call. Of image i: cost and of each array the part that begins at i times its length.
struct Scratch {
  View<double> p;        // [rows, slots]
  View<double> log_sum;  // [rows, 1]
  View<double> cost;     // [images * segments, slots], by size of the segment
  View<double> of_row;   // [images, segments + 1]
  View<double> of_column, least;
  View<std::int32_t> size, order;           // [images, segments]
  View<std::int32_t> slot;                  // [images, segments], -1: none
  View<std::int32_t> row_of, before, done;  // [images, slots + 1]
};

__device__ std::int64_t warp_number() {
  return (static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x) / kWarp;
}

__device__ double warp_max(double value) {
  for (int offset = kWarp / 2; offset > 0; offset /= 2) value = fmax(value, __shfl_xor_sync(kFullMask, value, offset));
  return value;
}

__global__ void __launch_bounds__(kThreads) softmax_kernel(GroupingCall call, Scratch to) {
  const std::int64_t row = warp_number();
  if (row >= call.rows.rows) return;
  const auto lane = static_cast<std::int32_t>(threadIdx.x % kWarp);
  double most = -INFINITY, all = 0;
  for (std::int32_t k = lane; k < call.rows.cols; k += kWarp) most = fmax(most, static_cast<double>(call.rows(row, k)));
  most = warp_max(most);
  for (std::int32_t k = lane; k < call.rows.cols; k += kWarp)
    all += to.p(row, k) = exp(static_cast<double>(call.rows(row, k)) - most);
  all = warp_sum(all);
  for (std::int32_t k = lane; k < call.rows.cols; k += kWarp) to.p(row, k) /= all;
  if (lane == 0) to.log_sum(row, 0) = most + log(all);
}

// Segments by size, the larger first and of equal ones the first: place of each, and its cost.
__device__ std::int32_t rows_of_image(const GroupingCall& call, const Scratch& s, std::int64_t image) {
  const std::int64_t first = image * call.per_image;
  const std::int32_t segments = call.segments(image, 0), slots = call.rows.cols;
  __shared__ std::int32_t used;
  if (threadIdx.x == 0) used = 0;
  for (std::int32_t a = threadIdx.x; a < segments; a += kThreads) {
    std::int32_t size = 0;
    for (std::int64_t i = 0; i < call.per_image; ++i) size += call.segment(first + i, 0) == a ? 1 : 0;
    s.size(image, a) = size;
    s.slot(image, a) = -1;
  }
  __syncthreads();
  for (std::int32_t a = threadIdx.x; a < segments; a += kThreads) {
    const std::int32_t size = s.size(image, a);
    if (size == 0) continue;
    std::int32_t place = 0;
    for (std::int32_t b = 0; b < segments; ++b)
      place += s.size(image, b) > size || (s.size(image, b) == size && b < a) ? 1 : 0;
    s.order(image, place) = a;
    atomicMax(&used, place + 1);
  }
  __syncthreads();
  const std::int32_t rows = min(used, slots);
  const std::int64_t base = image * call.most_segments;
  for (std::int32_t k = threadIdx.x; k < slots; k += kThreads) {
    for (std::int32_t r = 0; r < rows; ++r) {
      const std::int32_t a = s.order(image, r);
      double sum = 0;
      for (std::int64_t i = 0; i < call.per_image; ++i)
        if (call.segment(first + i, 0) == a) sum -= s.p(first + i, k);
      s.cost(base + r, k) = sum / s.size(image, a);
    }
  }
  __syncthreads();
  return rows;
}

// The least of the block's values, of equal ones that of the lowest column; every thread gets both.
__device__ void block_least(double& value, std::int32_t& column) {
  __shared__ double of_warp[kThreads / kWarp];
  __shared__ std::int32_t column_of_warp[kThreads / kWarp];
  const auto take = [&](double v, std::int32_t c) {
    if (v < value || (v == value && c < column)) value = v, column = c;
  };
  for (int offset = kWarp / 2; offset > 0; offset /= 2)
    take(__shfl_xor_sync(kFullMask, value, offset), __shfl_xor_sync(kFullMask, column, offset));
  __syncthreads();
  if (threadIdx.x % kWarp == 0) of_warp[threadIdx.x / kWarp] = value, column_of_warp[threadIdx.x / kWarp] = column;
  __syncthreads();
  for (int w = 0; w < kThreads / kWarp; ++w) take(of_warp[w], column_of_warp[w]);
}

// cheapest_assignment() with the columns of a search shared among threads.
__global__ void __launch_bounds__(kThreads) assign_kernel(GroupingCall call, Scratch s) {
  const std::int64_t image = blockIdx.x, base = image * call.most_segments;
  const std::int32_t columns = call.rows.cols, rows = rows_of_image(call, s, image);
  double *const of_row = s.of_row.row(image), *const of_column = s.of_column.row(image),
                *const least = s.least.row(image);
  std::int32_t *const row_of = s.row_of.row(image), *const before = s.before.row(image),
                      *const done = s.done.row(image);
  for (std::int32_t c = threadIdx.x; c <= columns; c += kThreads) of_column[c] = 0, row_of[c] = 0, before[c] = 0;
  for (std::int32_t r = threadIdx.x; r <= rows; r += kThreads) of_row[r] = 0;
  for (std::int32_t row = 1; row <= rows; ++row) {
    __syncthreads();
    for (std::int32_t c = threadIdx.x; c <= columns; c += kThreads) least[c] = INFINITY, done[c] = 0;
    if (threadIdx.x == 0) row_of[0] = row;
    __syncthreads();
    std::int32_t at = 0;
    while (row_of[at] != 0) {
      if (threadIdx.x == 0) done[at] = 1;
      __syncthreads();
      const std::int32_t r = row_of[at];
      double step = INFINITY;
      std::int32_t next = columns + 1;
      for (std::int32_t c = 1 + threadIdx.x; c <= columns; c += kThreads) {
        if (done[c] != 0) continue;
        const double reduced = s.cost(base + r - 1, c - 1) - of_row[r] - of_column[c];
        if (reduced < least[c]) least[c] = reduced, before[c] = at;
        if (least[c] < step) step = least[c], next = c;
      }
      block_least(step, next);
      for (std::int32_t c = threadIdx.x; c <= columns; c += kThreads) {
        if (done[c] != 0) {
          of_row[row_of[c]] += step;
          of_column[c] -= step;
        } else {
          least[c] -= step;
        }
      }
      at = next;
      __syncthreads();
    }
    if (threadIdx.x == 0)
      for (; at != 0; at = before[at]) row_of[at] = row_of[before[at]];
  }
  __syncthreads();
  for (std::int32_t c = 1 + threadIdx.x; c <= columns; c += kThreads)
    if (row_of[c] != 0) s.slot(image, s.order(image, row_of[c] - 1)) = c - 1;
}

__global__ void __launch_bounds__(kThreads) gradient_kernel(GroupingCall call, Scratch s) {
  const std::int64_t row = warp_number();
  if (row >= call.rows.rows) return;
  const std::int32_t own = s.slot(row / call.per_image, call.segment(row, 0));
  if (own < 0) return;
  const auto lane = static_cast<std::int32_t>(threadIdx.x % kWarp);
  for (std::int32_t k = lane; k < call.rows.cols; k += kWarp)
    call.gradients(row, k) += static_cast<float>(call.scale * (s.p(row, k) - (k == own ? 1 : 0)));
  if (lane == 0 && !call.loss.empty()) call.loss(row, 0) = s.log_sum(row, 0) - static_cast<double>(call.rows(row, own));
}

void add(const Grouping&, const GroupingCall& call, Workspace& arena) {
  const std::int64_t images = call.segments.rows;
  const std::int32_t slots = call.rows.cols, segments = call.most_segments;
  if (images == 0 || call.per_image == 0) return;
  Scratch s;
  s.p = arena.take<double>(call.rows.rows, slots);
  s.log_sum = arena.take<double>(call.rows.rows, 1);
  s.cost = arena.take<double>(images * segments, slots);
  s.of_row = arena.take<double>(images, segments + 1);
  for (View<double>* view : {&s.of_column, &s.least}) *view = arena.take<double>(images, slots + 1);
  for (View<std::int32_t>* view : {&s.size, &s.order, &s.slot}) *view = arena.take<std::int32_t>(images, segments);
  for (View<std::int32_t>* view : {&s.row_of, &s.before, &s.done}) *view = arena.take<std::int32_t>(images, slots + 1);
  const unsigned blocks = blocks_of(call.rows.rows * kWarp, kThreads);
  softmax_kernel<<<blocks, kThreads, 0, launch().stream>>>(call, s);
  assign_kernel<<<static_cast<unsigned>(images), kThreads, 0, launch().stream>>>(call, s);
  gradient_kernel<<<blocks, kThreads, 0, launch().stream>>>(call, s);
  check_launch("assignment of segments");
}

const GroupingKernels<Assignment> kTable{add};

}  // namespace

void assignment_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "grouping 'assignment'", &kTable); }

}  // namespace semfield::cuda
