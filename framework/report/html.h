// Small pieces of HTML for the report.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <string_view>

namespace semfield {

/// Text made safe for element content and quoted attributes: & < > " ' are escaped, control characters become U+FFFD.
std::string html_escape(std::string_view text);

/// Standard base64 with padding [RFC4648, Sec. 4].
std::string base64(std::span<const std::uint8_t> bytes);

/// "data:image/png;base64,..."
std::string png_data_uri(std::span<const std::uint8_t> png);

/// A figure for people: `digits` significant digits, no exponent between 1e-4 and 1e6; "∞" and "NaN" for those.
std::string figure_text(double value, int digits = 4);

/// The report's style sheet: light and dark by the reader's preference, series colours --s0..--s7.
std::string_view report_style();

}  // namespace semfield
