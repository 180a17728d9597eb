#include "loading/capture/misplaced.h"

#include <algorithm>
#include <map>
#include <unordered_set>

namespace semfield {

namespace {

constexpr std::size_t kLongestRun = 3;
constexpr double kJump = 5;              // times the way between neighbours
constexpr std::size_t kNeighbours = 30;  // points that the photographs around it share, at least
constexpr double kFew = 0.05;            // of these, or else of its own, shared with it
constexpr double kLeft = 0.6;            // of its points, in an image that fits them; blurred ones keep 0.7
constexpr double kWeak = 0.5;            // of the usual number of points, seen in an image that is hardly held

class Shares {
 public:
  explicit Shares(const std::vector<const ColmapImage*>& images) {
    for (const ColmapImage* image : images) points_.emplace_back(image->points.begin(), image->points.end());
  }
  std::size_t count(std::size_t image) const { return points_[image].size(); }
  std::size_t of(std::size_t a, std::size_t b) const {
    const auto& [few, many] =
        points_[a].size() < points_[b].size() ? std::tie(points_[a], points_[b]) : std::tie(points_[b], points_[a]);
    return static_cast<std::size_t>(
        std::count_if(few.begin(), few.end(), [&many = many](std::int64_t id) { return many.contains(id); }));
  }

 private:
  std::vector<std::unordered_set<std::int64_t>> points_;
};

double median(std::vector<double> values) {
  const auto middle = values.begin() + std::ssize(values) / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

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
  const Shares shares(images);
  std::vector<double> steps, seen;
  for (std::size_t i = 0; i < images.size(); ++i) {
    if (i > 0) steps.push_back(apart(i - 1, i));
    seen.push_back(static_cast<double>(shares.count(i)));
  }
  const double usual_step = median(steps), usual_count = median(seen);
  for (std::size_t first = 1; first + 1 < images.size(); ++first) {
    for (std::size_t run = 1; run <= kLongestRun && first + run < images.size(); ++run) {
      const std::size_t before = first - 1, last = first + run - 1, after = first + run;
      const double least = kJump * std::max(usual_step, apart(before, after) / static_cast<double>(run + 1));
      if (apart(before, first) < least || apart(last, after) < least) continue;
      const auto shares_few = [&](std::size_t of) {
        return static_cast<double>(shares.of(before, first)) < kFew * static_cast<double>(of) &&
               static_cast<double>(shares.of(last, after)) < kFew * static_cast<double>(of);
      };
      const std::size_t around = shares.of(before, after);
      const bool denied = around >= kNeighbours && shares_few(around);
      const double most = *std::max_element(seen.begin() + static_cast<std::ptrdiff_t>(first),
                                            seen.begin() + static_cast<std::ptrdiff_t>(after));
      const bool weak = most < kWeak * usual_count && shares_few(static_cast<std::size_t>(most));
      if (!denied && !weak) continue;
      for (std::size_t i = first; i <= last; ++i) out.push_back(images[i]->name);
      first = last;
      break;
    }
  }
  std::sort(out.begin(), out.end());
  return out;
}

std::vector<std::string> torn_images(const ColmapModel& model, const ColmapModel& kept) {
  std::map<std::string, std::size_t> left;
  for (const ColmapImage& image : kept.images) left[image.name] = image.points.size();
  std::vector<std::string> out;
  for (const ColmapImage& image : model.images)
    if (static_cast<double>(left[image.name]) < kLeft * static_cast<double>(image.points.size()))
      out.push_back(image.name);
  std::sort(out.begin(), out.end());
  return out;
}

}  // namespace semfield
