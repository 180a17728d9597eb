// Pieces of HTML pages that stand alone.
#pragma once

#include <cstdint>
#include <map>
#include <span>
#include <string>
#include <string_view>

namespace semfield {

/// Text made safe for element content and quoted attributes: & < > " ' are escaped, control characters become U+FFFD.
std::string html_escape(std::string_view text);

/// Standard base64 with padding [RFC4648, Sec. 4].
std::string base64(std::span<const std::uint8_t> bytes);

/// JSON for a script element: nothing in it may end the element.
std::string script_json(std::string json);

/// `page` with every place of `parts` filled; what fills one is not looked at again, whatever it holds. Throws
/// Error(no_input) where a place is missing.
std::string filled_page(const std::string& page, std::map<std::string, std::string> parts);

}  // namespace semfield
