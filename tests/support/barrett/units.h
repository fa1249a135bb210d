// A stand-in for libbarrett: as much of its names as `thirdhand_wam` uses, and an arm whose joints
// are where the reference is.
#pragma once
#include <array>
#include <cstddef>

#define BARRETT_UNITS_TEMPLATE_TYPEDEFS(DOF)                                                       \
    typedef std::array<double, DOF> jp_type;                                                       \
    typedef std::array<double, DOF> jv_type
