// What pages request, as it comes over the wire: JSON read strictly, and numbers of queries. Every refusal is
// Error(data) with a sentence that names the key.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "app/app_context.h"
#include "core/error.h"
#include "eval/evaluator.h"
#include "labels/serve/view_pictures.h"
#include "labels/strict_json.h"
#include "scene/camera.h"

namespace semfield::app {

/// Error(data), "request: ...".
Error request_error(const std::string& message, const std::string& remedy);
inline constexpr StrictJson<Json> kRequest{request_error};

/// A map whose keys are known and given once.
Json parse_request(std::string_view text, const std::vector<std::string>& known);
/// A whole number; `otherwise` where the key is missing, which without one is refused.
std::int32_t request_number(const Json& root, const char* key, std::int32_t low, std::int32_t high,
                            std::optional<std::int32_t> otherwise = {});

/// N numbers of at most this size, of the key `key`.
template <std::size_t N>
std::array<double, N> request_numbers(const Json& map, const char* key, double most) {
  const std::string expected = std::to_string(N) + " numbers";
  const Json& list = kRequest.at(map, key);
  if (!list.is_array() || list.size() != N) kRequest.refuse_value(key, expected, list);
  std::array<double, N> out{};
  for (std::size_t i = 0; i < N; ++i) {
    if (!list[i].is_number()) kRequest.refuse_value(key, expected, list[i]);
    out[i] = list[i].template get<double>();
    if (!(std::abs(out[i]) <= most)) kRequest.refuse_value(key, expected + " of a size that a scene can have", list[i]);
  }
  return out;
}

struct FreeCamera {
  Pose world_from_camera;
  double fov_deg = 60;  ///< horizontal

  /// The rays of a picture of this size, in pixels.
  RayCamera rays(std::int32_t width_px, std::int32_t height_px) const;
};
/// {"position", "rotation", "fov_deg"}: rows of world_from_camera, degrees of the picture's width.
FreeCamera read_request_camera(const Json& map);

inline constexpr std::int32_t kMostPictureSide = 2048;  ///< pixels of a picture of `view`
inline constexpr std::int32_t kMostPhotoSide = 65536;   ///< pixels that a request for a photograph may name

/// Throws Error(data) with a sentence that names the key, for every value out of its bounds and for keys that are
/// missing, unknown or given twice. That the view exists is the session's to say.
PictureRequest parse_picture_request(std::string_view json);
/// Likewise, of a thing.
PictureRequest parse_thing_request(std::string_view json);

/// Value of `key` in a query "a=1&b=2"; none where it is missing.
std::optional<std::string_view> query_value(std::string_view query, std::string_view key);

/// The same as a whole number from 0 to `most`; `otherwise` where it is missing. Throws Error(data).
std::uint64_t query_number(std::string_view query, std::string_view key, std::uint64_t otherwise, std::uint64_t most);

}  // namespace semfield::app
