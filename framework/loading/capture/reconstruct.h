// The ladder of attempts by which photographs get poses, and what is said of those that get none.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "loading/capture/colmap_steps.h"
#include "loading/capture/prepare_state.h"

namespace semfield {

/// What kind of lens took the photographs. `automatic` is a perspective one until no attempt with it is enough.
/// `equirectangular` are panoramas, which come as perspective views of 90 degrees.
enum class LensAsked : std::uint8_t { automatic, fisheye, equirectangular };

/// A model that COLMAP made.
struct FoundModel {
  std::string folder;
  std::vector<std::string> images;  ///< names, sorted
  std::size_t points = 0;
  double error_px = 0;  ///< mean reprojection error
  bool bent = false;    ///< a perspective lens that bends the border of an image as only wide lenses do
};

inline constexpr int kMostAttempts = 4;

struct ReconstructTask {
  std::vector<std::string> names;  ///< of the images, in the order in which they were taken
  bool in_order = false;           ///< frames of a film: neighbours are neighbours
  bool camera_per_folder = false;
  std::string work;  ///< folder
  LensAsked lens = LensAsked::automatic;
  int attempts = 0;  ///< at most; 0: those of an earlier call that ended with a model, or kMostAttempts
  /// Told of an attempt that was not enough, before the next.
  std::function<void(const std::string&)> note = [](const std::string&) {};
};

struct Reconstruction {
  FoundModel best;                     ///< of all attempts, refined
  std::vector<FoundModel> others;      ///< of the attempt that found it
  std::vector<std::string> misplaced;  ///< names of images that it was found with at a wrong place; not in it
  int attempts = 0;
};

/// From the cheapest attempt to the most patient, until 95 % of the images have a pose under a lens that fits, which
/// misses their points by at most 1.1 pixels and bends their borders by at most 15 %: features at 1,024 pixels; asking
/// less of an image that joins; more and fainter features at 1,600 pixels, every pair, and a richer lens; the same with
/// a fisheye's. Asked for a fisheye, all attempts have one. The largest model of all goes through settle_model(). Pairs
/// are all pairs up to 150 photographs, beyond and in films those of pairs_in_order(). Throws Error(data) where nothing
/// was found.
Reconstruction reconstruct(const ReconstructTask& task, const ColmapSteps& colmap, PrepareState& state);

/// Images without a pose that follow each other, and what to do.
struct Missing {
  std::size_t first = 0, last = 0;  ///< places among all names, from 0
  std::string text;                 ///< "photographs 12 to 19 (a.jpg to h.jpg) share too little ...: take some between"
};
/// `blurred` are names of blurred images among those that are missing.
std::vector<Missing> missing_images(const std::vector<std::string>& names, const Reconstruction& found,
                                    const std::vector<std::string>& blurred);

}  // namespace semfield
