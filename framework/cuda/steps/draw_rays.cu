// Pixels chosen, sorted within tiles and cast to rays. Compiled without fused multiplications and additions.
#include "cuda/kernels/device_code.cuh"
#include "cuda/steps/batch_drawer.h"
#include "scene/scene.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kSortThreads = 1024;
constexpr int kGroups = 3;  // of RayGroup: label_only, labelled, other

// The last entry that is not above `value`, of `count` ascending ones.
template <class T>
__device__ std::int64_t last_not_above(const T* ascending, std::int64_t count, std::int64_t value) {
  std::int64_t low = 0, high = count;  // ascending[low] <= value < ascending[high]
  while (high - low > 1) {
    const std::int64_t middle = low + (high - low) / 2;
    (static_cast<std::int64_t>(ascending[middle]) <= value ? low : high) = middle;
  }
  return low;
}

// Empty frames have the same offset as the next one: the last of them owns the pixel.
__device__ DrawnRay at_pixel(const HeldPixels& held, std::int64_t pixel) {
  DrawnRay ray;
  ray.pixel = pixel;
  ray.frame = static_cast<std::int32_t>(last_not_above(held.offsets, held.frame_count, pixel));
  return ray;
}

// As RaySource::labelled_pixel.
__device__ DrawnRay labelled_pixel(const HeldPixels& held, std::int64_t block_pixels, std::uint32_t rank) {
  const std::int64_t block = last_not_above(held.ranks_before, held.blocks, rank);
  DrawnRay ray;
  ray.frame = static_cast<std::int32_t>(last_not_above(held.block_offsets, held.frame_count, block));
  ray.pixel = held.offsets[ray.frame] + (block - held.block_offsets[ray.frame]) * block_pixels;
  for (std::uint32_t left = rank - held.ranks_before[block];; ++ray.pixel) {
    if (held.label[ray.pixel] == kNoLabel) continue;
    if (left-- == 0) return ray;
  }
}

// As RaySource::used_pixel.
__device__ DrawnRay used_pixel(const HeldPixels& held, std::uint32_t rank) {
  const std::int64_t block = last_not_above(held.used_before, held.used_blocks, rank);
  DrawnRay ray;
  ray.frame = static_cast<std::int32_t>(last_not_above(held.used_block_offsets, held.frame_count, block));
  unsigned long long word = held.used_words[block];
  for (std::uint32_t left = rank - held.used_before[block]; left > 0; --left) word &= word - 1;
  ray.pixel = held.offsets[ray.frame] + (block - held.used_block_offsets[ray.frame]) * PixelMask::kWordPixels +
              (__ffsll(static_cast<long long>(word)) - 1);
  return ray;
}

// As label_only_rays of one ray.
__device__ bool for_its_label(const DrawRule& rule, std::int64_t ray) {
  if (rule.choice != PixelChoice::label_balanced) return false;
  return static_cast<std::int64_t>(floor(static_cast<double>(ray + 1) * rule.labelled_share)) >
         static_cast<std::int64_t>(floor(static_cast<double>(ray) * rule.labelled_share));
}

// blockIdx.y: step; one thread per ray.
__global__ void __launch_bounds__(kThreads)
    choose_kernel(const __grid_constant__ HeldPixels held, const __grid_constant__ DrawRule rule, std::int64_t first,
                  DrawnRay* chosen) {
  const std::int64_t ray = thread_index();
  if (ray >= rule.rays) return;
  const auto step = static_cast<std::uint64_t>(first + blockIdx.y);
  constexpr std::uint32_t kPixel = stream_id("ray_source/pixel"), kFrame = stream_id("ray_source/frame");
  const RandomAddress address{rule.seed, step, kPixel};
  const auto index = static_cast<std::uint64_t>(ray);
  const bool labelled = for_its_label(rule, ray);
  DrawnRay drawn;
  if (rule.choice == PixelChoice::one_image) {
    drawn.frame = static_cast<std::int32_t>(
        uniform_below({rule.seed, step, kFrame}, 0, static_cast<std::uint64_t>(held.frame_count)));
    if (held.used_words != nullptr) {
      const std::uint32_t first = held.used_before[held.used_block_offsets[drawn.frame]];
      const std::uint32_t used = held.used_before[held.used_block_offsets[drawn.frame + 1]] - first;
      drawn = used_pixel(held, first + static_cast<std::uint32_t>(uniform_below(address, index, used)));
    } else {
      const std::int64_t begin = held.offsets[drawn.frame], pixels = held.offsets[drawn.frame + 1] - begin;
      drawn.pixel =
          begin + static_cast<std::int32_t>(uniform_below(address, index, static_cast<std::uint64_t>(pixels)));
    }
  } else if (labelled) {
    drawn = labelled_pixel(held, rule.block,
                           static_cast<std::uint32_t>(uniform_below(address, index, held.ranks_before[held.blocks])));
  } else if (held.used_words != nullptr) {
    drawn =
        used_pixel(held, static_cast<std::uint32_t>(uniform_below(address, index, held.used_before[held.used_blocks])));
  } else {
    const auto pixels = static_cast<std::uint64_t>(held.offsets[held.frame_count]);
    drawn = at_pixel(held, static_cast<std::int64_t>(uniform_below(address, index, pixels)));
  }
  drawn.label = held.label == nullptr ? kNoLabel : held.label[drawn.pixel];
  drawn.group = rule.labels_apart && labelled ? 0 : drawn.label != kNoLabel ? 1 : 2;
  chosen[static_cast<std::int64_t>(blockIdx.y) * rule.rays + ray] = drawn;
}

// A block per tile (x) of a step (y): rows by group, in order within each.
__global__ void __launch_bounds__(kSortThreads) sort_kernel(const __grid_constant__ DrawRule rule, DrawnRay* chosen) {
  __shared__ std::int32_t of_warp[kGroups][kWarp];
  __shared__ std::int32_t next[kGroups];  // row
  const std::int64_t begin = static_cast<std::int64_t>(blockIdx.x) * rule.tile_rays;
  const std::int64_t end = begin + rule.tile_rays < rule.rays ? begin + rule.tile_rays : rule.rays;
  DrawnRay* const of_step = chosen + static_cast<std::int64_t>(blockIdx.y) * rule.rays;
  const int lane = static_cast<int>(threadIdx.x) % kWarp, warp = static_cast<int>(threadIdx.x) / kWarp;
  if (threadIdx.x < kGroups) next[threadIdx.x] = 0;
  __syncthreads();
  std::int32_t counted[kGroups] = {};
  for (std::int64_t ray = begin + threadIdx.x; ray < end; ray += kSortThreads) {
    const int group = of_step[ray].group;
    for (int g = 0; g < kGroups; ++g) counted[g] += g == group ? 1 : 0;
  }
  for (int g = 0; g < kGroups; ++g) {
    const std::int32_t sum = warp_sum(counted[g]);
    if (lane == 0) atomicAdd(&next[g], sum);
  }
  __syncthreads();
  if (threadIdx.x == 0) {
    std::int32_t row = static_cast<std::int32_t>(begin);
    for (int g = 0; g < kGroups; ++g) {
      const std::int32_t count = next[g];
      next[g] = row;
      row += count;
    }
  }
  for (std::int64_t at = begin; at < end; at += kSortThreads) {
    const std::int64_t ray = at + threadIdx.x;
    const int group = ray < end ? of_step[ray].group : kGroups;
    unsigned own = 0;
    __syncthreads();  // rows are known, and of_warp is free
    for (int g = 0; g < kGroups; ++g) {
      const unsigned votes = __ballot_sync(kFullMask, group == g);
      if (group == g) own = votes;
      if (lane == 0) of_warp[g][warp] = __popc(votes);
    }
    __syncthreads();
    if (group < kGroups) {
      std::int32_t row = next[group] + __popc(own & ((1U << lane) - 1));
      for (int w = 0; w < warp; ++w) row += of_warp[group][w];
      of_step[ray].row = row;
    }
    __syncthreads();
    if (threadIdx.x < kGroups) {
      for (int w = 0; w < kSortThreads / kWarp; ++w) next[threadIdx.x] += of_warp[threadIdx.x][w];
    }
  }
}

template <class T>
__device__ T* of_step(T* array, std::int64_t stride, unsigned step) {
  return array == nullptr
             ? nullptr
             : reinterpret_cast<T*>(reinterpret_cast<std::byte*>(array) + stride * static_cast<std::int64_t>(step));
}

// blockIdx.y: step; one thread per ray: some 20 B read at random, 76 B written.
__global__ void __launch_bounds__(kThreads)
    cast_kernel(const __grid_constant__ HeldPixels held, const __grid_constant__ DrawRule rule, const DrawnRay* chosen,
                const __grid_constant__ DrawnBatches batches) {
  const std::int64_t ray = thread_index();
  if (ray >= rule.rays) return;
  const DrawnRay drawn = chosen[static_cast<std::int64_t>(blockIdx.y) * rule.rays + ray];
  const HeldFrame& frame = held.frames[drawn.frame];
  const std::int64_t index = drawn.pixel - held.offsets[drawn.frame], row = drawn.row;
  Vec3d local;
  if (frame.direction != nullptr) {
    const double* const from = frame.direction + 3 * index;
    local = {from[0], from[1], from[2]};
  } else {
    const auto column = static_cast<std::int32_t>(index % frame.width_px);
    const auto line = static_cast<std::int32_t>(index / frame.width_px);
    local = pinhole_direction(frame.fx, frame.fy, frame.cx, frame.cy, column + 0.5, line + 0.5);
  }
  double* const near_far = of_step(batches.near_far, batches.stride, blockIdx.y) + 2 * row;
  const double cosine = ray_of_direction(local, frame.world_from_camera, frame.lens, rule.limits,
                                         of_step(batches.origin, batches.stride, blockIdx.y) + 3 * row,
                                         of_step(batches.direction, batches.stride, blockIdx.y) + 3 * row, near_far);
  float* const target = of_step(batches.target, batches.stride, blockIdx.y) + 3 * row;
  for (int c = 0; c < 3; ++c) target[c] = static_cast<float>(held.rgb[3 * drawn.pixel + c]) / 255.0F;
  if (batches.label != nullptr) of_step(batches.label, batches.stride, blockIdx.y)[row] = drawn.label;
  if (batches.camera != nullptr)
    of_step(batches.camera, batches.stride, blockIdx.y)[row] = static_cast<float>(drawn.frame);
  if (batches.alpha != nullptr) {  // as RaySource::write_row
    const bool known = frame.has_alpha && drawn.group != 0;
    of_step(batches.alpha, batches.stride, blockIdx.y)[row] =
        known ? static_cast<float>(held.alpha[drawn.pixel]) / 255.0F : -1.0F;
  }
  if (batches.depth == nullptr) return;
  float depth = 0;  // as RaySource::depth_of
  if (cosine > 0 && drawn.group != 0) {
    const double t = static_cast<double>(held.depth_m[drawn.pixel]) / cosine;
    if (t > near_far[0] && t < near_far[1]) depth = static_cast<float>(t);
  }
  of_step(batches.depth, batches.stride, blockIdx.y)[row] = depth;
}

}  // namespace

void draw_rays(const HeldPixels& pixels, const DrawRule& rule, std::int64_t first, int count, DrawnRay* scratch,
               const DrawnBatches& batches) {
  const auto steps = static_cast<unsigned>(count);
  const dim3 by_ray(blocks_of(rule.rays, kThreads), steps);
  const dim3 by_tile(static_cast<unsigned>((rule.rays + rule.tile_rays - 1) / rule.tile_rays), steps);
  queue("choosing pixels", by_ray, kThreads, choose_kernel, pixels, rule, first, scratch);
  queue("sorting rays", by_tile, kSortThreads, sort_kernel, rule, scratch);
  queue("casting rays", by_ray, kThreads, cast_kernel, pixels, rule, scratch, batches);
}

}  // namespace semfield::cuda
