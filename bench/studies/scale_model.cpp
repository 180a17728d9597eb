#include "studies/scale_model.h"

#include <algorithm>
#include <cmath>

#include "core/error.h"

namespace semfield {

namespace {

constexpr double kNearlyMost = 0.99;  // of the most rays per second; what comes then is not worth a device

int hosts_of(const ScaleSystem& system, int devices) { return (devices + system.per_host - 1) / system.per_host; }

double message_seconds(const ScaleLink& link, double bytes) { return link.latency_s + bytes / link.bytes_per_s; }

// Messages of `bytes` in all that walk over a path of links one behind the other: the first takes the whole path, the
// others follow at the pace of the slowest link.
double walk_seconds(const ScaleSystem& system, int inside_hops, int between_hops, double bytes) {
  const double messages = std::max(1.0, std::ceil(bytes / system.message_bytes)), each = bytes / messages;
  const double inside = inside_hops > 0 ? message_seconds(system.inside, each) : 0,
               between = between_hops > 0 ? message_seconds(system.between, each) : 0;
  return inside_hops * inside + between_hops * between + (messages - 1) * std::max(inside, between);
}

int levels_of(int count) {
  int levels = 0;
  for (int reached = 1; reached < count; reached *= 2) ++levels;
  return levels;
}

double ring_or_tree(const ScaleLink& link, int count, double bytes) {
  if (count < 2) return 0;
  const double ring = 2 * (count - 1) * message_seconds(link, bytes / count);
  const double tree = 2 * (levels_of(count) * link.latency_s + bytes / link.bytes_per_s);
  return std::min(ring, tree);
}

}  // namespace

double largest_share(const ScaleStep& step, int devices) {
  if (step.lanes <= 0) return 1.0 / devices;
  return std::ceil(static_cast<double>(step.lanes) / devices) / step.lanes;
}

double sum_seconds(const ScaleSystem& system, int devices, double bytes) {
  if (devices < 2 || bytes <= 0) return 0;
  const int hosts = hosts_of(system, devices);
  if (system.exchange == ScaleExchange::all_reduce) {
    return ring_or_tree(system.inside, std::min(devices, system.per_host), bytes) +
           ring_or_tree(system.between, hosts, bytes);
  }
  const int within = levels_of(std::min(devices, system.per_host));
  return walk_seconds(system, devices - hosts, hosts - 1, bytes) +
         walk_seconds(system, within, levels_of(hosts), bytes);
}

double gather_seconds(const ScaleSystem& system, int devices, double bytes) {
  if (devices < 2 || bytes <= 0) return 0;
  // A ring: every device hands on the part that it got last, until it has all parts.
  const int hosts = hosts_of(system, devices);
  const double part = bytes / devices;
  const double inside = message_seconds(system.inside, part);
  return (devices - 1) * (hosts > 1 ? std::max(inside, message_seconds(system.between, part)) : inside);
}

ScaleTime predict_step(const ScaleStep& step, const ScaleSystem& system, int devices, double rays) {
  if (devices < 1 || !(rays > 0)) {
    throw Error(ErrorKind::usage, "usage.value.range", "a step is predicted for at least one device and some rays",
                "give both above 0");
  }
  ScaleTime time;
  const double split_s = step.split_s_per_ray * rays * largest_share(step, devices);
  time.compute_s = step.fixed_s + step.repeated_s_per_ray * rays + split_s;
  const double early = sum_seconds(system, devices, step.overlapped_share * step.gradient_bytes),
               late = sum_seconds(system, devices, (1 - step.overlapped_share) * step.gradient_bytes),
               gathered = gather_seconds(system, devices, step.gathered_bytes_per_ray * rays);
  time.exchange_s = early + late + gathered;
  time.exposed_s = std::max(0.0, early - step.hiding_share * split_s) + late + gathered;
  return time;
}

double predict_speedup(const ScaleStep& step, const ScaleSystem& system, int devices, double rays, bool strong) {
  const double all = strong ? rays : rays * devices;
  const double one_s = predict_step(step, system, 1, rays).step_s() / rays;
  return one_s / (predict_step(step, system, devices, all).step_s() / all);
}

ScaleLimits scale_limits(const ScaleStep& step, const ScaleSystem& system, double rays, bool strong, int most) {
  ScaleLimits limits;
  std::vector<double> speedups;
  for (int devices = 1; devices <= most; ++devices) {
    speedups.push_back(predict_speedup(step, system, devices, rays, strong));
    if (speedups.back() >= 0.5 * devices) limits.half_efficient = devices;
  }
  const double enough = kNearlyMost * *std::max_element(speedups.begin(), speedups.end());
  while (speedups[static_cast<std::size_t>(limits.fastest) - 1] < enough) ++limits.fastest;
  return limits;
}

ScaleStep fit_step(std::span<const ScaleSample> samples) {
  if (samples.empty())
    throw Error(ErrorKind::usage, "study.result.missing",
                "the cost of a step is fitted to measurements on one device, and there are none", "measure one");
  // Of a + b r = s with weights 1 / s^2.
  double w = 0, wr = 0, wrr = 0, ws = 0, wrs = 0;
  for (const ScaleSample& sample : samples) {
    const double weight = 1 / (sample.seconds * sample.seconds), r = sample.rays, s = sample.seconds;
    w += weight;
    wr += weight * r;
    wrr += weight * r * r;
    ws += weight * s;
    wrs += weight * r * s;
  }
  ScaleStep step;
  const double determinant = w * wrr - wr * wr;
  if (determinant > 1e-12 * w * wrr) {
    step.fixed_s = (ws * wrr - wrs * wr) / determinant;
    step.split_s_per_ray = (w * wrs - wr * ws) / determinant;
  }
  if (step.split_s_per_ray < 0) {
    step.split_s_per_ray = 0;
    step.fixed_s = ws / w;
  } else if (step.fixed_s <= 0) {
    step.fixed_s = 0;
    step.split_s_per_ray = wrs / wrr;
  }
  return step;
}

ScaleStep with_repeated(ScaleStep step, const ScaleSystem& system, int devices, const ScaleSample& measured) {
  const double per_ray = step.split_s_per_ray + step.repeated_s_per_ray;
  const auto time_with = [&](double repeated) {
    step.repeated_s_per_ray = repeated;
    step.split_s_per_ray = per_ray - repeated;
    return predict_step(step, system, devices, measured.rays).step_s();
  };
  double low = 0, high = per_ray;  // the time grows with what is repeated
  if (time_with(high) <= measured.seconds) return step;
  for (int i = 0; i < 60; ++i) {
    const double middle = 0.5 * (low + high);
    (time_with(middle) < measured.seconds ? low : high) = middle;
  }
  time_with(low);
  return step;
}

}  // namespace semfield
