#include "loading/capture/misplaced.h"

#include <algorithm>
#include <map>
#include <unordered_set>

namespace semfield {

namespace {

constexpr std::size_t kLongestRun = 3;
constexpr double kJump = 5;              // times the way between neighbours
constexpr std::size_t kNeighbours = 30;  // points that the photographs around it share, at least
constexpr double kFew = 0.05;            // of these, shared with it

class Shares {
 public:
  explicit Shares(const std::vector<const ColmapImage*>& images) {
    for (const ColmapImage* image : images) points_.emplace_back(image->points.begin(), image->points.end());
  }
  std::size_t of(std::size_t a, std::size_t b) const {
    const auto& [few, many] =
        points_[a].size() < points_[b].size() ? std::tie(points_[a], points_[b]) : std::tie(points_[b], points_[a]);
    return static_cast<std::size_t>(
        std::count_if(few.begin(), few.end(), [&many = many](std::int64_t id) { return many.contains(id); }));
  }

 private:
  std::vector<std::unordered_set<std::int64_t>> points_;
};

}  // namespace

std::vector<std::string> misplaced_images(const ColmapModel& model, const std::vector<std::string>& names) {
  std::map<std::string, const ColmapImage*> by_name;
  for (const ColmapImage& image : model.images) by_name[image.name] = &image;
  std::vector<const ColmapImage*> images;  // with a pose, in the order in which they were taken
  for (const std::string& name : names) {
    if (const auto found = by_name.find(name); found != by_name.end()) images.push_back(found->second);
  }
  std::vector<std::string> out;
  if (images.size() < 2 * kLongestRun) return out;
  const auto apart = [&](std::size_t a, std::size_t b) {
    return length(images[a]->world_from_camera.t - images[b]->world_from_camera.t);
  };
  std::vector<double> steps;
  for (std::size_t i = 1; i < images.size(); ++i) steps.push_back(apart(i - 1, i));
  const auto middle = steps.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2);
  std::nth_element(steps.begin(), middle, steps.end());
  const double usual = *middle;
  const Shares shares(images);
  for (std::size_t first = 1; first + 1 < images.size(); ++first) {
    for (std::size_t run = 1; run <= kLongestRun && first + run < images.size(); ++run) {
      const std::size_t before = first - 1, last = first + run - 1, after = first + run;
      const double least = kJump * std::max(usual, apart(before, after));
      if (apart(before, first) < least || apart(last, after) < least) continue;
      const std::size_t around = shares.of(before, after);
      const auto few = [&](std::size_t a, std::size_t b) {
        return static_cast<double>(shares.of(a, b)) < kFew * static_cast<double>(around);
      };
      if (around < kNeighbours || !few(before, first) || !few(last, after)) continue;
      for (std::size_t i = first; i <= last; ++i) out.push_back(images[i]->name);
      first = last;
      break;
    }
  }
  std::sort(out.begin(), out.end());
  return out;
}

}  // namespace semfield
