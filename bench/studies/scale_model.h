// How long a training step takes on many processes or devices, from what it takes on one and what has to be exchanged.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

namespace semfield {

/// A message of b bytes takes latency_s + b / bytes_per_s.
struct ScaleLink {
  std::string name;  ///< "shared memory"
  double latency_s = 0, bytes_per_s = 1;
};

/// How gradients meet. A chain keeps the order of every sum: the running sum walks from rank to rank in messages, each
/// rank adds what it has to one message while its neighbour adds to the next, and the whole sum goes back to all. An
/// all-reduce is a ring or a tree, whichever is faster, first within hosts and then between them.
enum class ScaleExchange : std::uint8_t { chain, all_reduce };

/// The machines: `per_host` ranks or devices on each host, linked by `inside`, hosts by `between`.
struct ScaleSystem {
  std::string name;
  ScaleExchange exchange = ScaleExchange::chain;
  int per_host = 1;
  ScaleLink inside, between;
  double message_bytes = 1;  ///< of the chain
};

/// What a step costs. A device's time is fixed_s + repeated_s_per_ray * rays + split_s_per_ray * (its own rays).
struct ScaleStep {
  double fixed_s = 0;                 ///< every device does it whole: optimiser, derived tensors, starts of kernels
  double split_s_per_ray = 0;         ///< rays are dealt out: both directions through the networks
  double repeated_s_per_ray = 0;      ///< every device does it for all rays: adding gathered rows to a table
  double gradient_bytes = 0;          ///< summed over all devices once per step
  double gathered_bytes_per_ray = 0;  ///< brought from every device to every device
  int lanes = 0;  ///< rays are dealt out in so many equal shares; 0: one by one. More devices than shares idle.
  /// While the networks that own this share of the gradients are summed, ...
  double overlapped_share = 0;
  /// ... this share of the split work is still computed.
  double hiding_share = 0;
};

struct ScaleTime {
  double compute_s = 0;
  double exchange_s = 0;  ///< as if nothing else went on meanwhile
  double exposed_s = 0;   ///< what of it the step waits for
  double step_s() const { return compute_s + exposed_s; }
};

/// Largest share of the rays that one of `devices` gets.
double largest_share(const ScaleStep& step, int devices);
/// Seconds in which `bytes` on every device become their sum on every device. 0 for one device.
double sum_seconds(const ScaleSystem& system, int devices, double bytes);
/// Seconds in which every device gets what all have, `bytes` in all. 0 for one device.
double gather_seconds(const ScaleSystem& system, int devices, double bytes);
/// A step of `rays` rays in all. Throws Error(usage) for fewer than 1 device or no rays.
ScaleTime predict_step(const ScaleStep& step, const ScaleSystem& system, int devices, double rays);

/// `strong`: `rays` rays on one device and on many. Otherwise weak: `rays` rays on each device.
/// How many times the rays per second of one device; `devices` at best.
double predict_speedup(const ScaleStep& step, const ScaleSystem& system, int devices, double rays, bool strong);

struct ScaleLimits {
  int half_efficient = 1;  ///< the most devices, 1 to `most`, on which a half of each is still of use
  int fastest = 1;         ///< the fewest devices with 99 % of the most rays per second
};
ScaleLimits scale_limits(const ScaleStep& step, const ScaleSystem& system, double rays, bool strong, int most);

/// A measurement on one device.
struct ScaleSample {
  double rays = 0, seconds = 0;
};
/// fixed_s and split_s_per_ray that fit the samples with the least sum of squared relative errors; neither is negative.
/// One sample says nothing of what is fixed, which is then 0. Throws Error(usage) without samples.
ScaleStep fit_step(std::span<const ScaleSample> samples);
/// The part of split_s_per_ray that every device repeats, so that `devices` devices take `seconds` for `rays` rays; all
/// other values of `step` stay, and so does the time of one device. Between none of it and all of it.
ScaleStep with_repeated(ScaleStep step, const ScaleSystem& system, int devices, const ScaleSample& measured);

}  // namespace semfield
