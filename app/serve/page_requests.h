// What the page requests, as it comes over the wire: JSON of pictures and exports, numbers of queries.
#pragma once

#include <optional>
#include <string>
#include <string_view>

#include "serve/label_loop.h"

namespace semfield::app {

inline constexpr std::int32_t kMostPictureSide = 2048;  ///< pixels of a free camera's picture
inline constexpr std::int32_t kMostPhotoSide = 65536;   ///< pixels that a request for a photograph may name

/// Throws Error(data) with a sentence that names the key, for every value out of its bounds and for keys that are
/// missing, unknown or given twice. That the view exists is the session's to say.
PictureRequest parse_picture_request(std::string_view json);

enum class ExportKind { labels, coco, mesh, film };
const char* export_name(ExportKind kind);
/// What is to be made, or else the id of the export that is to end.
struct ExportRequest {
  std::optional<ExportKind> what;
  std::string cancel;
};
/// Throws as parse_picture_request does.
ExportRequest parse_export_request(std::string_view json);

/// Value of `key` in a query "a=1&b=2"; none where it is missing.
std::optional<std::string_view> query_value(std::string_view query, std::string_view key);

/// The same as a whole number from 0 to `most`; `otherwise` where it is missing. Throws Error(data).
std::uint64_t query_number(std::string_view query, std::string_view key, std::uint64_t otherwise, std::uint64_t most);

}  // namespace semfield::app
